"""A flight as PX4 topics, one CSV a topic as `ulog2csv` writes them: <prefix>_<topic>_0.csv, time in microseconds.

World NED, body FRD, SI units; from ENU and FLU by

    p_NED = N p_ENU,   v_FRD = B v_FLU,   R_FRD->NED = N R B
    N = [[0, 1, 0], [1, 0, 0], [0, 0, -1]],   B = diag(1, -1, -1)

`actuator_outputs.output[i]` holds the commanded static thrust of rotor i in newtons, in the vehicle's own order: a
flight of this program has no pulse widths.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from quadexp.files.writer import write_text
from quadexp.log.exporters.table_csv import write_columns
from quadexp.log.importers.mapped import turn_attitude
from quadexp.log.schema import Flight
from quadexp.log.signal import continuous
from quadexp.log.units import axes_matrix

NED_ENU, FRD_FLU = axes_matrix("world", "NED", ""), axes_matrix("body", "FRD", "")
UNITS = {
    "timestamp": "us",
    "vehicle_local_position": "x y z: m, vx vy vz: m/s (NED), heading: rad from north",
    "vehicle_local_position_setpoint": "x y z: m, vx vy vz: m/s (NED), yaw: rad from north",
    "vehicle_attitude": "q[0..3]: quaternion FRD to NED, w first",
    "vehicle_angular_velocity": "xyz[0..2]: rad/s (FRD)",
    "actuator_outputs": "output[i]: commanded static thrust of rotor i (N)",
    "actuator_motors": "control[i]: normalised command of rotor i, in the vehicle's own order",
    "battery_status": "voltage_v: V",
    "sensor_combined": "gyro_rad: rad/s, accelerometer_m_s2: m/s^2 (FRD), *_integral_dt: us",
}

Topic = dict[str, np.ndarray]


def write(flight: Flight, path: Path, *, force: bool = True) -> dict[str, Path]:
    """Write the folder `path`; returns topic -> file."""
    timestamp = np.round(1e6 * flight.t).astype(np.int64)
    files = {
        name: write_columns(path / f"{path.name}_{name}_0.csv", {"timestamp": timestamp, **topic}, force=force)
        for name, topic in topics(flight, timestamp).items()
    }
    about = {"units": UNITS, "record": flight.metadata}
    text = json.dumps(about, indent=1) + "\n"
    return files | {"about": write_text(path / f"{path.name}_about.json", text, force=force)}


def topics(flight: Flight, timestamp: np.ndarray) -> dict[str, Topic]:
    """The topics that the flight has columns for; timestamp: (k,) (us)."""
    has = flight.columns.keys()  # a recorded flight may lack any of them
    made: dict[str, Topic] = {}
    if {"p_x", "v_x", "q_w"} <= has:
        made["vehicle_local_position"] = _position(flight, "", "heading")
    if "q_w" in has:
        made["vehicle_attitude"] = _vector("q", _attitude(flight, ""))
    if "w_x" in has:
        made["vehicle_angular_velocity"] = _vector("xyz", _body(flight, "w"))
    if flight.n_rotors:
        made["actuator_outputs"] = {"noutputs": np.full(len(flight), flight.n_rotors)} | _vector("output", flight.input)
    commands = [name for name in flight.columns if name.startswith("motor_command_")]
    if commands:
        made["actuator_motors"] = _vector("control", flight.stack(commands))
    if "battery_voltage" in has:
        made["battery_status"] = {"voltage_v": flight["battery_voltage"]}
    if {"ref_p_x", "ref_v_x", "ref_q_w"} <= has:
        made["vehicle_local_position_setpoint"] = _position(flight, "ref_", "yaw")
    if {"acc_x", "w_x"} <= has:
        interval = np.diff(timestamp, prepend=timestamp[:1])
        made["sensor_combined"] = (
            _vector("gyro_rad", _body(flight, "w"))
            | {"gyro_integral_dt": interval}
            | _vector("accelerometer_m_s2", _body(flight, "acc"))
            | {"accelerometer_integral_dt": interval}
        )
    return made


def _position(flight: Flight, prefix: str, heading: str) -> Topic:
    position = flight.stack([f"{prefix}p_{axis}" for axis in "xyz"]) @ NED_ENU.T
    velocity = flight.stack([f"{prefix}v_{axis}" for axis in "xyz"]) @ NED_ENU.T
    w, x, y, z = _attitude(flight, prefix).T
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return dict(zip("xyz", position.T, strict=True)) | {
        **{f"v{axis}": values for axis, values in zip("xyz", velocity.T, strict=True)},
        heading: yaw,
    }


def _attitude(flight: Flight, prefix: str) -> np.ndarray:
    """Quaternion FRD to NED, (k, 4), w first; without jumps of its sign, w >= 0 at the start."""
    q = flight.stack([f"{prefix}q_{axis}" for axis in "wxyz"])
    turned = continuous(turn_attitude(q, NED_ENU, FRD_FLU))
    return turned if turned[0, 0] >= 0 else -turned


def _body(flight: Flight, quantity: str) -> np.ndarray:
    """A body vector, (k, 3), in FRD."""
    return flight.stack([f"{quantity}_{axis}" for axis in "xyz"]) @ FRD_FLU


def _vector(name: str, values: np.ndarray) -> Topic:
    return {f"{name}[{i}]": column for i, column in enumerate(values.T)}
