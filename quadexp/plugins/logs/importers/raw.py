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
from quadexp.log.runs import period_of
from quadexp.physics.state import finite_rows, norms
from quadexp.physics.vehicle import GRAVITY
from quadexp.plugins.logs.importers.mapping import IN_BODY, Crop, Entry, Mapping
from quadexp.plugins.logs.importers.quantities import QUANTITIES
from quadexp.plugins.logs.importers.table import Table
from quadexp.plugins.logs.signal import Stream, increasing
from quadexp.plugins.logs.signal.windows import rotations
from quadexp.plugins.logs.units import mounting_matrix

MOST_LATE = 0.01  # share of the rows that may lie out of order
MEASURED = ("position", "attitude", "velocity", "rate", "acceleration")
REGULAR = 0.9  # share of the changes that come evenly
LEAST_CHANGES = 20  # that tell a rate


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
    count = len(t)
    values = values.reshape(count, -1)
    good = np.isfinite(t) & finite_rows(values)
    if not good.any():
        raise DataError(f"{path}: {name}: not one row of {count} is a number throughout")
    if not good.all():
        empty = count - int(good.sum())
        notes.append(f"{name}: {empty} of {count} rows ({empty / count:.1%}) are empty or not numbers")
        t = t[good]
        values = values[good]
    onward = increasing(t)
    lost = int((~onward).sum())
    if not lost:
        return Stream(t, values)
    back = np.flatnonzero(np.diff(t) < 0)
    if len(back) and lost > max(2, MOST_LATE * len(t)):
        row = int(back[0]) + 1
        text = f"({t[row - 1]:.9g} -> {t[row]:.9g} s; {lost} of {len(t)} rows are out of order)"
        way = "sort its rows by time, or cut the log there if its clock was set anew"
        raise DataError(f"{path}: {name}: time goes backwards at row {row} {text}: {way}")
    what = "repeat a time or go back in it" if len(back) else "repeat the time of the row before"
    notes.append(f"{name}: {lost} of {len(t)} rows ({lost / len(t):.1%}) {what}: dropped")
    return Stream(t[onward], values[onward])


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
    rows = np.arange(len(t))
    changed = np.concatenate([[0], changes])
    latest = changed[np.searchsorted(changes, rows, side="right")]
    kept = (rows - latest) % every == 0  # what stands still for longer is no gap
    rate = 1 / (every * period_of(t))
    notes.append(f"{name}: each value stands for {every} rows: taken as a stream of {rate:.3g} Hz")
    return Stream(t[kept], values[kept])


def read_mapped(table: Table, mapping: Mapping) -> RawLog:
    """Read a table by a mapping. Raises DataError naming the column that is missing or is not a number."""
    notes: list[str] = []
    columns = table.read(mapping.columns, notes)
    log = RawLog(mapping.format, {}, mapping.name, mapping.layout, mapping.crop, notes)
    if not len(columns[mapping.clock.column]):
        raise DataError(f"{table.path}: holds no rows")
    for name, entry in mapping.entries.items():
        clock = entry.clock or mapping.clock
        t = columns[clock.column] * clock.factor
        values = np.column_stack([columns[column] for column in entry.columns])
        where = f"{name} ({', '.join(entry.columns)})"
        stream = clean_stream(table.path, where, t, values, notes)
        if name in MEASURED:
            stream = without_repeats(name, stream, notes)
        log.streams[name] = _convert(name, entry, stream)
    log.streams = _turned_to_frame(log.streams, mapping.entries)
    for correction in mapping.corrections:
        log.streams = corrected(log.streams, correction)
    return log


def corrected(streams: dict[str, Stream], correction: Mapping) -> dict[str, Stream]:
    """Streams in SI, ENU and FLU, mended by lines of a mapping of which they are the log."""
    moved = {}
    for name, (t, values) in streams.items():
        stream = Stream(t * correction.clock.factor, values)
        moved[name] = _convert(name, correction.entries[name], stream)
    return _turned_to_frame(moved, correction.entries)


def _convert(name: str, entry: Entry, stream: Stream) -> Stream:
    """One stream in SI; vectors in ENU or FLU, whichever the entry says."""
    t, values = stream
    values = values * entry.factor
    if name.endswith("attitude"):
        return Stream(t, _attitude(entry, values))
    low, high = entry.range
    values = (values - low) / (high - low)
    if QUANTITIES[name].is_vector:
        mounting = mounting_matrix(entry.mounting)
        values = values @ entry.axes.T @ mounting.T - entry.offset
    return Stream(t, values)


def _attitude(entry: Entry, values: np.ndarray) -> np.ndarray:
    """Quaternion FLU to ENU, (k, 4), w first, of one as logged, or of roll, pitch and yaw (k, 3) (rad)."""
    if entry.order == "rpy":
        q = Rotation.from_euler("ZYX", values[:, ::-1]).as_quat(scalar_first=True)
    else:
        q = values[:, [entry.order.index(axis) for axis in "wxyz"]]
    if entry.direction == "world_to_body":
        q = q * np.array([1.0, -1.0, -1.0, -1.0])
    q = turn_attitude(q, entry.world, entry.axes)
    if min(entry.angles) < 0:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # nose straight up: yaw and roll are one angle
            angles = Rotation.from_quat(q, scalar_first=True).as_euler("ZYX")
        q = Rotation.from_euler("ZYX", angles * entry.angles[::-1]).as_quat(scalar_first=True)
    if entry.turn:
        turned = Rotation.from_euler("z", entry.turn, degrees=True) * rotations(q)
        q = norms(q)[:, None] * turned.as_quat(scalar_first=True)
    return q


def turn_attitude(q: np.ndarray, world: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Quaternion of W R(q) B^T, (k, 4), w first; its norm is kept, so that a wrong one stays visible."""
    if (world == np.eye(3)).all() and (body == np.eye(3)).all():
        return q
    if np.linalg.det(world) < 0:  # both are left-handed: turning both the same way changes nothing else
        mirror = np.diag([1.0, 1.0, -1.0])
        return turn_attitude(q * np.array([1.0, -1.0, -1.0, 1.0]), world @ mirror, body @ mirror)
    turned = Rotation.from_matrix(world) * rotations(q) * Rotation.from_matrix(body.T)
    return norms(q)[:, None] * turned.as_quat(scalar_first=True)


def _turned_to_frame(streams: dict[str, Stream], entries: dict[str, Entry]) -> dict[str, Stream]:
    """Velocities that the log has in the body go to the world, rates and accelerations to the body, accelerations to
    specific force."""
    turned = dict(streams)
    for name, entry in entries.items():
        to_world = name == "velocity" and entry.in_body
        to_body = name in IN_BODY and not entry.in_body
        if not (to_world or to_body or entry.is_motion):
            continue
        (t, values), R = with_attitude(streams, name)
        if to_world or to_body:
            values = R.apply(values, inverse=to_body)
        if entry.is_motion:
            values = values + R.apply([0.0, 0.0, GRAVITY], inverse=True)
        turned[name] = Stream(t, values)
    return turned


def velocity_to_world(streams: dict[str, Stream]) -> None:
    """Turn a velocity in FLU by the attitude."""
    stream, R = with_attitude(streams, "velocity")
    streams["velocity"] = Stream(stream.t, R.apply(stream.values))


def with_attitude(streams: dict[str, Stream], name: str) -> tuple[Stream, Rotation]:
    """The attitude at the times of a stream, and the stream as far as there is one."""
    stream = streams[name]
    if "attitude" not in streams:
        raise DataError(f"{name} has to be turned between world and body, but the log has no attitude")
    t, q = streams["attitude"]
    shortest = int(np.argmin(norms(q)))
    if not norms(q)[shortest] > 1e-6:
        raise DataError(f"attitude: a quaternion of length zero at row {shortest}")
    R = Rotation.from_quat(q, scalar_first=True)
    if np.array_equal(t, stream.t):
        return stream, R
    inside = (stream.t >= t[0]) & (stream.t <= t[-1])
    if len(t) < 2 or not inside.any():
        raise DataError(f"{name} and attitude have no time in common")
    part = Stream(stream.t[inside], stream.values[inside])
    return part, Slerp(t, R)(part.t)
