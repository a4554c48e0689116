"""From a table and a mapping to streams in SI, ENU and FLU.

R = W R_log B^T,   W, B: signed permutations of the log's world and body axes into ENU and FLU
specific force = R^T (coordinate acceleration + g e_z)
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from quadexp.errors import DataError
from quadexp.log.hypotheses.windows import multiply
from quadexp.log.importers.mapping_reader import Entry, Mapping
from quadexp.log.importers.raw import RawLog, clean_stream
from quadexp.log.importers.table import Table
from quadexp.log.signal import Stream
from quadexp.physics.vehicle import GRAVITY


def read_mapped(table: Table, mapping: Mapping) -> RawLog:
    """Read a table by a mapping. Raises DataError naming the column that is missing or is not a number."""
    notes: list[str] = []
    columns = table.read(mapping.columns, notes)
    log = RawLog(mapping.format, {}, mapping.name, mapping.layout, mapping.crop, notes)
    if not len(columns[mapping.clock.column]):
        raise DataError(f"{table.path}: holds no rows")
    for i, (name, entry) in enumerate(mapping.entries.items()):
        clock = entry.clock or mapping.clock
        t = columns[clock.column]
        if clock.factor != 1.0:
            t = t * clock.factor
        values = np.stack([columns[column] for column in entry.columns], axis=1)
        stream = clean_stream(table.path, f"{name} ({', '.join(entry.columns)})", t, values, notes)
        log.streams[name] = convert(name, entry, stream)
        later = {mapping.clock.column}
        for other in list(mapping.entries.values())[i + 1 :]:
            later |= {*other.columns, *([other.clock.column] if other.clock else [])}
        columns = {key: value for key, value in columns.items() if key in later}  # a long log fits in memory once
    turn_to_frame(log, mapping.entries)
    for correction in mapping.corrections:
        factor = correction.clock.factor
        for name, entry in correction.entries.items():
            t, values = log.streams[name]
            log.streams[name] = convert(name, entry, Stream(t if factor == 1.0 else t * factor, values))
        turn_to_frame(log, correction.entries)
    return log


def convert(name: str, entry: Entry, stream: Stream) -> Stream:
    """One stream in SI; vectors in ENU or FLU, whichever the entry says."""
    values = stream.values
    if name.endswith("attitude"):
        return Stream(stream.t, attitude(entry, values))
    if not (entry.factor == 1.0).all():
        values = values * entry.factor
    if name == "motor_command" and (entry.low, entry.high) != (0.0, 1.0):
        values = (values - entry.low) / (entry.high - entry.low)
    if values.shape[1] == 3 and not (entry.axes == np.eye(3)).all():
        values = values @ entry.axes.T
    if not (entry.mounting == np.eye(3)).all():
        values = values @ entry.mounting.T
    return Stream(stream.t, values)


def attitude(entry: Entry, values: np.ndarray) -> np.ndarray:
    """Quaternion FLU to ENU, (k, 4), w first; as logged where nothing has to be turned."""
    if entry.order == "rpy":
        roll, pitch, yaw = (values * entry.factor).T
        q = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1)).as_quat(scalar_first=True)
    else:
        values = values if (entry.factor == 1.0).all() else values * entry.factor
        q = values[:, [entry.order.index(axis) for axis in "wxyz"]]
    if entry.inverse:
        q = q * np.array([1.0, -1.0, -1.0, -1.0])
    return turn_attitude(q, entry.world, entry.axes)


def turn_attitude(q: np.ndarray, world: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Quaternion of W R(q) B^T, (k, 4), w first; its norm is kept, so that a wrong one stays visible."""
    identity = np.eye(3)
    if (world == identity).all() and (body == identity).all():
        return q
    if np.linalg.det(world) < 0:  # both are left-handed: turning both the same way changes nothing else
        mirror = np.diag([1.0, 1.0, -1.0])
        mirrored = q * np.array([1.0, -1.0, -1.0, 1.0])
        return turn_attitude(mirrored, world @ mirror, body @ mirror)
    w = Rotation.from_matrix(world).as_quat(scalar_first=True)
    b = Rotation.from_matrix(body.T).as_quat(scalar_first=True)
    return multiply(multiply(w, q), b)


def turn_to_frame(log: RawLog, entries: dict[str, Entry]) -> None:
    """Velocities that the log has in the body go to the world, rates and accelerations to the body, accelerations to
    specific force."""
    velocity, rate, acceleration = (entries.get(name) for name in ("velocity", "rate", "acceleration"))
    if velocity is not None and velocity.in_body:
        stream, R = with_attitude(log, "velocity", log.streams["velocity"])
        log.streams["velocity"] = Stream(stream.t, R.apply(stream.values))
    if rate is not None and not rate.in_body:
        stream, R = with_attitude(log, "rate", log.streams["rate"])
        log.streams["rate"] = Stream(stream.t, R.apply(stream.values, inverse=True))
    if acceleration is not None and not acceleration.in_body:
        stream, R = with_attitude(log, "acceleration", log.streams["acceleration"])
        gravity = np.array([0.0, 0.0, GRAVITY if acceleration.coordinate else 0.0])
        log.streams["acceleration"] = Stream(stream.t, R.apply(stream.values + gravity, inverse=True))
    elif acceleration is not None and acceleration.coordinate:
        stream, R = with_attitude(log, "acceleration", log.streams["acceleration"])
        up = R.apply(np.array([0.0, 0.0, GRAVITY]), inverse=True)
        log.streams["acceleration"] = Stream(stream.t, stream.values + up)


def with_attitude(log: RawLog, name: str, stream: Stream) -> tuple[Stream, Rotation]:
    """The attitude at the times of a stream, and the stream as far as there is one."""
    if "attitude" not in log.streams:
        raise DataError(f"{name} has to be turned between world and body, but the log has no attitude")
    q = log.streams["attitude"]
    norm = np.linalg.norm(q.values, axis=1)
    if not (norm > 1e-6).all():
        raise DataError(f"attitude: a quaternion of length zero at row {int(np.argmin(norm))}")
    R = Rotation.from_quat(q.values, scalar_first=True)
    if len(q.t) == len(stream.t) and (q.t == stream.t).all():
        return stream, R
    inside = (stream.t >= q.t[0]) & (stream.t <= q.t[-1])
    if len(q.t) < 2 or not inside.any():
        raise DataError(f"{name} and attitude have no time in common")
    return Stream(stream.t[inside], stream.values[inside]), Slerp(q.t, R)(stream.t[inside])
