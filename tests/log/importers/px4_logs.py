"""PX4 logs with the peculiarities that real ones have: an estimator without a position, setpoints for a part of the
flight, outputs that drive more than rotors, all at PX4's low default rates."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.log.importers import logs


def default_rates(
    path: Path,
    f: logs.Truth,
    *,
    xy_valid: np.ndarray | bool = True,
    setpoint: tuple[float, float] | None = None,
    outputs: int = 4,
    start: float = 5.0,
) -> Path:
    """f: at 250 Hz. Position and setpoint at 10 Hz, attitude at 50 Hz, gyro and accelerometer at 250 Hz, outputs at
    10 Hz. xy_valid: of the position's rows. setpoint: from when to when there is one (s)."""
    t = f.t + start
    log = logs.ULogWriter({"MAV_TYPE": 2.0})
    slow = slice(None, None, 25)
    valid = np.broadcast_to(np.asarray(xy_valid), t[slow].shape)
    position = np.where(valid[:, None], f.p[slow] @ logs.NED.T, [0, 0, -f.p[0, 2]])
    velocity = np.where(valid[:, None], f.v[slow] @ logs.NED.T, [0, 0, 0.01])
    log.format(
        "vehicle_local_position",
        "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;"
        "bool xy_valid;bool z_valid;bool v_xy_valid;bool v_z_valid;uint8_t xy_reset_counter;",
    )
    ones = np.ones(len(valid))
    counter = 1.0 + np.cumsum(np.diff(valid.astype(int), prepend=valid[:1].astype(int)) != 0)
    rows = np.column_stack([position, velocity, valid, ones, valid, ones, counter])
    log.topic("vehicle_local_position", t[slow], rows, "6f????B")
    log.format("vehicle_attitude", "uint64_t timestamp;float[4] q;")
    log.topic("vehicle_attitude", t[::5], logs.frd_quaternion(f)[::5], "4f")
    log.format(
        "sensor_combined", "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;float[3] accelerometer_m_s2;"
    )
    log.topic("sensor_combined", t, np.column_stack([f.w @ logs.FRD, np.full(len(t), 4000), f.acc @ logs.FRD]), "3fI3f")
    log.format("actuator_outputs", "uint64_t timestamp;uint32_t noutputs;float[16] output;")
    pulses = 1000 + 1000 * np.column_stack(
        [f.command[:, [0, 2, 3, 1]], *[0.5 + 0.2 * np.sin(f.t + i) for i in range(12)]]
    )
    pulses[:, outputs:] = 0
    log.topic("actuator_outputs", t[slow], np.column_stack([np.full(len(t), 16), pulses])[slow], "I16f")
    if setpoint is not None:
        log.format("vehicle_local_position_setpoint", "uint64_t timestamp;float x;float y;float z;")
        wanted = np.where(((f.t >= setpoint[0]) & (f.t <= setpoint[1]))[:, None], f.p @ logs.NED.T, np.nan)
        log.topic("vehicle_local_position_setpoint", t[slow], wanted[slow], "3f")
    return log.write(path)
