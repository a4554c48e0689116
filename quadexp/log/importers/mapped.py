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
    log.streams = turned_to_frame(log.streams, mapping.entries)
    for correction in mapping.corrections:
        log.streams = corrected(log.streams, correction)
    return log


def corrected(streams: dict[str, Stream], correction: Mapping) -> dict[str, Stream]:
    """Streams in SI, ENU and FLU, mended by lines of a mapping of which they are the log."""
    factor, made = correction.clock.factor, {}
    for name, (t, values) in streams.items():
        made[name] = convert(name, correction.entries[name], Stream(t if factor == 1.0 else t * factor, values))
    return turned_to_frame(made, correction.entries)


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
        q = values if entry.order == "wxyz" else values[:, [entry.order.index(axis) for axis in "wxyz"]]
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


def turned_to_frame(streams: dict[str, Stream], entries: dict[str, Entry]) -> dict[str, Stream]:
    """Velocities that the log has in the body go to the world, rates and accelerations to the body, accelerations to
    specific force."""
    made = dict(streams)
    for name, entry in entries.items():
        if name == "velocity" and entry.in_body:
            stream, R = with_attitude(streams, name)
            made[name] = Stream(stream.t, R.apply(stream.values))
        elif name == "rate" and not entry.in_body:
            stream, R = with_attitude(streams, name)
            made[name] = Stream(stream.t, R.apply(stream.values, inverse=True))
        elif name == "acceleration" and (entry.coordinate or not entry.in_body):
            stream, R = with_attitude(streams, name)
            gravity = np.array([0.0, 0.0, GRAVITY if entry.coordinate else 0.0])
            if entry.in_body:
                made[name] = Stream(stream.t, stream.values + R.apply(gravity, inverse=True))
            else:
                made[name] = Stream(stream.t, R.apply(stream.values + gravity, inverse=True))
    return made


def with_attitude(streams: dict[str, Stream], name: str) -> tuple[Stream, Rotation]:
    """The attitude at the times of a stream, and the stream as far as there is one."""
    stream = streams[name]
    if "attitude" not in streams:
        raise DataError(f"{name} has to be turned between world and body, but the log has no attitude")
    q = streams["attitude"]
    norm = np.linalg.norm(q.values, axis=1)
    if not (norm > 1e-6).all():
        raise DataError(f"attitude: a quaternion of length zero at row {int(np.argmin(norm))}")
    R = Rotation.from_quat(q.values, scalar_first=True)
    if len(q.t) == len(stream.t) and (q.t is stream.t or (q.t == stream.t).all()):
        return stream, R
    inside = (stream.t >= q.t[0]) & (stream.t <= q.t[-1])
    if len(q.t) < 2 or not inside.any():
        raise DataError(f"{name} and attitude have no time in common")
    return Stream(stream.t[inside], stream.values[inside]), Slerp(q.t, R)(stream.t[inside])
