"""What a reader hands over: streams on their own clocks, already in SI units, ENU and FLU, named by quantity; and how a
table becomes that by a mapping.

R = W R_log B^T,   W, B: signed permutations of the log's world and body axes into ENU and FLU
specific force = R^T (coordinate acceleration + g e_z)

A stream's time is the log's own (s), its values are (k, m).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from quadexp.errors import DataError
from quadexp.physics.state import finite_rows, norms
from quadexp.physics.vehicle import GRAVITY
from quadexp.plugins.logs.importers.mapping import IN_BODY, Crop, Entry, Mapping
from quadexp.plugins.logs.importers.table import Table
from quadexp.plugins.logs.signal import Stream, increasing
from quadexp.plugins.logs.signal.windows import rotations

MOST_LATE = 0.01  # share of the rows that may lie out of order
MEASURED = ("position", "attitude", "velocity", "rate", "acceleration")
REGULAR, LEAST_CHANGES = 0.9, 20  # share of the changes that come evenly; changes


@dataclass
class RawLog:
    """One log, read. mapping: name of the mapping, or of the reader's convention. layout: position of each of the log's
    motors ("front_right", ...), or None where they stand in the vehicle's own order. about: for the flight's record.
    resets: of the estimator, the last time before one and the first after it (s)."""

    format: str
    streams: dict[str, Stream]
    mapping: str = ""
    layout: tuple[str, ...] | None = None
    crop: Crop = field(default_factory=Crop)
    notes: list[str] = field(default_factory=list)
    about: dict[str, Any] = field(default_factory=dict)
    resets: list[tuple[float, float]] = field(default_factory=list)


def clean_stream(path: Path, name: str, t: np.ndarray, values: np.ndarray, notes: list[str]) -> Stream:
    """A stream without rows that are not numbers or repeat a time; what was dropped is noted.

    Raises DataError where no number is left, or the clock runs backwards.
    """
    count, values = len(t), values.reshape(len(t), -1)
    good = np.isfinite(t) & finite_rows(values)
    if not good.any():
        raise DataError(f"{path}: {name}: not one row of {count} is a number throughout")
    if not good.all():
        empty = count - int(good.sum())
        notes.append(f"{name}: {empty} of {count} rows ({empty / count:.1%}) are empty or not numbers")
        t, values = t[good], values[good]
    late = increasing(t)
    if late.all():
        return Stream(t, values)
    lost, back = int((~late).sum()), np.flatnonzero(np.diff(t) < 0)
    if len(back) and lost > max(2, MOST_LATE * len(t)):
        row = int(back[0]) + 1
        text = f"({t[row - 1]:.9g} -> {t[row]:.9g} s; {lost} of {len(t)} rows are out of order)"
        way = "sort its rows by time, or cut the log there if its clock was set anew"
        raise DataError(f"{path}: {name}: time goes backwards at row {row} {text}: {way}")
    if lost:
        what = "repeat a time or go back in it" if len(back) else "repeat the time of the row before"
        notes.append(f"{name}: {lost} of {len(t)} rows ({lost / len(t):.1%}) {what}: dropped")
    return Stream(t[late], values[late])


def sorted_stream(path: Path, name: str, t: np.ndarray, values: np.ndarray, notes: list[str]) -> Stream:
    """As clean_stream, of rows that may lie out of order: they are put into the order of their times."""
    order = np.argsort(t, kind="stable")
    return clean_stream(path, name, t[order], values[order], notes)


def without_repeats(name: str, stream: Stream, notes: list[str]) -> Stream:
    """A stream that is slower than its table, which repeats every value until the next one comes: on its own clock,
    else what is derived from it goes in steps. What was left out is noted.

    They come evenly: those of a coarse sensor, or of a vehicle that stands, do not. (Where the table's rate is no
    multiple of the stream's, the times of its values are not known to a row, and it stays as it is.)
    """
    t, values = stream
    changes = np.flatnonzero((values[1:] != values[:-1]).any(axis=1)) + 1
    if len(changes) < LEAST_CHANGES:
        return stream
    apart = np.diff(changes)
    every = int(np.median(apart))
    if every < 2 or np.mean(apart == every) < REGULAR:
        return stream
    first = np.concatenate([[0], changes])
    since = np.arange(len(t)) - np.repeat(first, np.diff(np.append(first, len(t))))
    kept = since % every == 0  # what stands still for longer is no gap
    rate = 1 / (every * float(np.median(np.diff(t))))
    notes.append(f"{name}: each value stands for {every} rows: taken as a stream of {rate:.3g} Hz")
    return Stream(t[kept], values[kept])


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
        values = np.column_stack([columns[column] for column in entry.columns])
        stream = clean_stream(table.path, f"{name} ({', '.join(entry.columns)})", t, values, notes)
        if name in MEASURED:
            stream = without_repeats(name, stream, notes)
        log.streams[name] = _convert(name, entry, stream)
        later = {mapping.clock.column}
        for other in list(mapping.entries.values())[i + 1 :]:
            later |= {*other.columns, *([other.clock.column] if other.clock else [])}
        columns = {key: value for key, value in columns.items() if key in later}  # a long log fits in memory once
    log.streams = _turned_to_frame(log.streams, mapping.entries)
    for correction in mapping.corrections:
        log.streams = corrected(log.streams, correction)
    return log


def corrected(streams: dict[str, Stream], correction: Mapping) -> dict[str, Stream]:
    """Streams in SI, ENU and FLU, mended by lines of a mapping of which they are the log."""
    factor, moved = correction.clock.factor, {}
    for name, (t, values) in streams.items():
        moved[name] = _convert(name, correction.entries[name], Stream(t if factor == 1.0 else t * factor, values))
    return _turned_to_frame(moved, correction.entries)


def _convert(name: str, entry: Entry, stream: Stream) -> Stream:
    """One stream in SI; vectors in ENU or FLU, whichever the entry says."""
    values = stream.values
    if name.endswith("attitude"):
        return Stream(stream.t, _attitude(entry, values))
    if not (entry.factor == 1.0).all():
        values = values * entry.factor
    if name == "motor_command" and (entry.low, entry.high) != (0.0, 1.0):
        values = (values - entry.low) / (entry.high - entry.low)
    if values.shape[1] == 3 and not (entry.axes == np.eye(3)).all():
        values = values @ entry.axes.T
    if not (entry.mounting == np.eye(3)).all():
        values = values @ entry.mounting.T
    if entry.offset.any():
        values = values - entry.offset
    return Stream(stream.t, values)


def _attitude(entry: Entry, values: np.ndarray) -> np.ndarray:
    """Quaternion FLU to ENU, (k, 4), w first; as logged where nothing has to be turned."""
    if entry.order == "rpy":
        roll, pitch, yaw = (values * entry.factor).T
        q = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll])).as_quat(scalar_first=True)
    else:
        values = values if (entry.factor == 1.0).all() else values * entry.factor
        q = values if entry.order == "wxyz" else values[:, [entry.order.index(axis) for axis in "wxyz"]]
    if entry.inverse:
        q = q * np.array([1.0, -1.0, -1.0, -1.0])
    q = turn_attitude(q, entry.world, entry.axes)
    if min(entry.angles) < 0:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # nose straight up: yaw and roll are one angle
            yaw, pitch, roll = Rotation.from_quat(q, scalar_first=True).as_euler("ZYX").T
        angles = np.column_stack([yaw, pitch, roll]) * np.array(entry.angles[::-1])
        q = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)
    if entry.turn:
        q = norms(q)[:, None] * (Rotation.from_euler("z", entry.turn) * rotations(q)).as_quat(scalar_first=True)
    return q


def turn_attitude(q: np.ndarray, world: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Quaternion of W R(q) B^T, (k, 4), w first; its norm is kept, so that a wrong one stays visible."""
    identity = np.eye(3)
    if (world == identity).all() and (body == identity).all():
        return q
    if np.linalg.det(world) < 0:  # both are left-handed: turning both the same way changes nothing else
        mirror = np.diag([1.0, 1.0, -1.0])
        mirrored = q * np.array([1.0, -1.0, -1.0, 1.0])
        return turn_attitude(mirrored, world @ mirror, body @ mirror)
    turned = Rotation.from_matrix(world) * rotations(q) * Rotation.from_matrix(body.T)
    return norms(q)[:, None] * turned.as_quat(scalar_first=True)


def _turned_to_frame(streams: dict[str, Stream], entries: dict[str, Entry]) -> dict[str, Stream]:
    """Velocities that the log has in the body go to the world, rates and accelerations to the body, accelerations to
    specific force."""
    turned = dict(streams)
    for name, entry in entries.items():
        to_world, to_body = name == "velocity" and entry.in_body, name in IN_BODY and not entry.in_body
        if not (to_world or to_body or entry.coordinate):
            continue
        (t, values), R = with_attitude(streams, name)
        gravity = np.array([0.0, 0.0, GRAVITY if entry.coordinate else 0.0])
        if to_world:
            turned[name] = Stream(t, R.apply(values))
        elif to_body:
            turned[name] = Stream(t, R.apply(values + gravity, inverse=True))
        else:
            turned[name] = Stream(t, values + R.apply(gravity, inverse=True))
    return turned


def with_attitude(streams: dict[str, Stream], name: str) -> tuple[Stream, Rotation]:
    """The attitude at the times of a stream, and the stream as far as there is one."""
    stream = streams[name]
    if "attitude" not in streams:
        raise DataError(f"{name} has to be turned between world and body, but the log has no attitude")
    q = streams["attitude"]
    norm = norms(q.values)
    if not (norm > 1e-6).all():
        raise DataError(f"attitude: a quaternion of length zero at row {int(np.argmin(norm))}")
    R = Rotation.from_quat(q.values, scalar_first=True)
    if len(q.t) == len(stream.t) and (q.t is stream.t or (q.t == stream.t).all()):
        return stream, R
    inside = (stream.t >= q.t[0]) & (stream.t <= q.t[-1])
    if len(q.t) < 2 or not inside.any():
        raise DataError(f"{name} and attitude have no time in common")
    return Stream(stream.t[inside], stream.values[inside]), Slerp(q.t, R)(stream.t[inside])
