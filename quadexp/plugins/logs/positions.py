"""Rows of a file with positions: a sampled track, or waypoints, distinguished by the file's first line.

    CSV track      a header with the columns t, p_x, p_y, p_z and, if there, yaw or heading, or q_w .. q_z (s, m, rad;
                   world ENU; body to world); 8 rows or more
    CSV waypoints  a header with the columns x, y, z and, if there, t and yaw (m, s, rad; world ENU); 2 rows or more
    TUM track      t x y z qx qy qz qw, separated by blanks, no header (s, m; quaternion body to world)

Other columns are ignored, which the trajectory's note says, and lines that begin with #; but one with commas above the
first row is a header, as EuRoC writes it. A name may end in its unit: time_ms, p_x [mm], yaw_deg. Below a header,
columns may be parted by semicolons, tabs or blanks too, the first two with decimal commas or points. The yaw of an
attitude follows the convention of the reference: y_body level with (-sin yaw, cos yaw, 0).
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from quadexp.errors import DataError
from quadexp.names import named
from quadexp.physics.rotation import heading
from quadexp.physics.state import norms
from quadexp.plugins.logs.column_names import groups, unit_of
from quadexp.plugins.logs.importers.readers import way_of
from quadexp.plugins.logs.units import UNITS
from quadexp.reference.base import LONGEST

MIN_ROWS = 8  # of a track, needed by the degree-7 spline
MIN_POINTS = 2  # make a line
MAX_POINTS = 200  # beyond, a path is a track of samples
TRACK = ("t", "p_x", "p_y", "p_z")
WAYPOINTS = ("x", "y", "z")
ATTITUDE = ("q_w", "q_x", "q_y", "q_z")
MOST_IGNORED = 6  # columns that the note lists
EPOCH = {1e17: 1e-9, 1e14: 1e-6, 1e11: 1e-3}  # times from these on -> s of their unit: since 1970 they are of 1973 on
SI = {"1": 1.0} | UNITS["time"] | UNITS["length"] | UNITS["angle"]
GAP = 10.0  # times the median step between two rows: rows are missing
TUM = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
HEADINGS = ("yaw", "heading")  # rad, unless name or numbers say degrees
FULL_TURN = 6.5  # rad: a heading that stays within is taken as radians
FASTEST = np.pi / 2  # rad/s: a heading that turns on and on no faster is in rad, as the guide says
ALONG = 0.95  # length of the mean direction of heading less course: held
NOT_ALONG = 0.7  # likewise: not held


@dataclass(frozen=True)
class Positions:
    """Content of a file. sampled: True for a track, False for waypoints.

    times: (k,), s; None for waypoints without times. points: (k, 3), world (m). yaw: (k,), unwrapped (rad), or None.
    ignored: columns that are not flown.
    """

    sampled: bool
    times: np.ndarray | None
    points: np.ndarray
    yaw: np.ndarray | None
    ignored: tuple[str, ...] = ()

    @property
    def notes(self) -> list[str]:
        """What of the file is not flown, and where a track has no rows."""
        notes = []
        if self.ignored:
            names = [*self.ignored[:MOST_IGNORED], *[".."] * (len(self.ignored) > MOST_IGNORED)]
            notes.append(f"columns that are not flown: {', '.join(names)}")
        if self.sampled and self.times is not None:
            steps = np.diff(self.times)
            at = int(np.argmax(steps))
            if steps[at] > GAP * np.median(steps):
                after = self.times[at] - self.times[0]
                notes.append(f"rows are missing: none for {steps[at]:.3g} s after {after:.4g} s of the track")
        return notes


def read_positions(path: Path) -> Positions:
    """The rows of a CSV or TUM file.

    Raises DataError with the line number for a missing column, a value that is not a finite number, time that does not
    increase, repeated waypoints without times, or too few or too many rows.
    """
    lines = _lines(path)
    factors: dict[str, float] = {}  # to SI, where the names say a unit
    header = list(TUM)
    columns: tuple[str, ...] = TUM
    ignored: list[str] = []
    if "," in lines[0][1]:
        (first, names), *lines = lines
        given = [name.strip() for name in next(csv.reader([names]))]
        header, factors = _known(given)
        columns = _columns(f"{path}, line {first}", header)
        rows = [next(csv.reader([line])) for _, line in lines]
        ignored = [name for name, known in zip(given, header, strict=True) if known not in columns]
    else:
        rows = [line.split() for _, line in lines]
    wheres = [f"{path}, line {number}" for number, _ in lines]
    table = [_numbers(where, row, header, columns) for where, row in zip(wheres, rows, strict=True)]
    values = named(columns, np.array(table).reshape(len(rows), len(columns)).T)
    values = {name: factors.get(name, 1.0) * column for name, column in values.items()}
    sampled = columns[: len(WAYPOINTS)] != WAYPOINTS
    points = np.column_stack([values[name] for name in (columns[1:4] if sampled else WAYPOINTS)])
    if sampled and len(points) < MIN_ROWS:
        other = "for waypoints name the columns x, y, z"
        raise DataError(f"{path}: {len(points)} rows, a track needs at least {MIN_ROWS}; {other}")
    if not sampled and not MIN_POINTS <= len(points) <= MAX_POINTS:
        other = f"for a sampled track name the columns {', '.join(TRACK)}"
        raise DataError(f"{path}: {len(points)} waypoints, {MIN_POINTS} to {MAX_POINTS} are allowed; {other}")
    times = values.get("t")
    if times is None:
        _check_moving(wheres, points)
    else:
        _check_increasing(wheres, times)
        if "t" not in factors:
            times = times * next((factor for least, factor in EPOCH.items() if times[0] > least), 1.0)
        if np.ptp(times) > LONGEST:
            units = "if they are not in s, name the column time_ms, time_us or time_ns"
            raise DataError(f"{path}: its times span {np.ptp(times):.4g} s, {LONGEST:g} s are allowed; {units}")
    yaw = None
    attitude = TUM[4:] if columns == TUM else (*ATTITUDE[1:], ATTITUDE[0])
    if columns[-1] in HEADINGS:
        name = columns[-1]
        yaw = values[name] if name in factors else _in_radians(path, name, values[name], points, times)
    elif set(attitude) <= values.keys():
        yaw = _heading(wheres, np.column_stack([values[name] for name in attitude]))
    if yaw is not None:
        yaw = np.unwrap(yaw)
    return Positions(sampled, times, points, yaw, tuple(ignored))


def _lines(path: Path) -> list[tuple[int, str]]:
    """Number and text of the lines that are neither empty nor comments; a comment that names the columns, the last one
    above the numbers, is none."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise DataError(f"{path}: not a readable text file ({error})") from None
    except UnicodeDecodeError as error:
        way = way_of(path, path.read_bytes())
        raise DataError(f"{path}: {way or f'not a readable text file ({error})'}") from None
    lines: list[tuple[int, str]] = []
    heading: list[tuple[int, str]] = []
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith("#") and "," in line and not lines:
            heading = [(number, line.lstrip("# "))]
        elif line.strip() and not line.startswith("#"):
            lines.append((number, line))
    if not lines:
        raise DataError(f"{path}: no rows (a track needs at least {MIN_ROWS}, waypoints {MIN_POINTS})")
    first = lines[0][1]
    names = any(letter.isalpha() for letter in first.lower().replace("e", ""))  # it names the columns itself
    for mark in ";\t" if names else ";":  # parts columns where numbers have decimal commas
        if mark in first:
            lines = [(number, line.replace(",", ".").replace(mark, ",")) for number, line in lines]
    if names and "," not in lines[0][1]:
        lines = [(number, ",".join(line.split())) for number, line in lines]
    return lines if names else heading + lines


def _check_increasing(wheres: list[str], times: np.ndarray) -> None:
    for where, (before, now) in zip(wheres[1:], pairwise(times), strict=True):
        if now <= before:
            way = "the row is there twice: leave one of both out" if now == before else "time must increase"
            raise DataError(f"{where}: t = {now:.9g} s is not after {before:.9g} s, {way}")


def _check_moving(wheres: list[str], points: np.ndarray) -> None:
    for where, (before, now) in zip(wheres[1:], pairwise(points), strict=True):
        if np.array_equal(before, now):
            raise DataError(f"{where}: the same point as in the previous row; add a column t to stay there")


def _known(given: list[str]) -> tuple[list[str], dict[str, float]]:
    """The columns' names as this program has them, also where other ones say as much (column_names.py), and the factors
    to SI of those with a unit."""
    units = [unit_of(name) for name in given]
    header = [bare if unit in SI else name for name, (bare, unit) in zip(given, units, strict=True)]
    known = groups(given)
    wanted = (("time", TRACK[:1], ()), ("position", TRACK[1:], WAYPOINTS), ("attitude", ATTITUDE, ()))
    for quantity, names, others in wanted:
        if not any(name in header for name in (*names, *others)):
            for place, name in zip(*known.get(quantity, [[]])[:1], names, strict=False):
                header[place] = name
    return header, {name: SI[unit] for name, (_, unit) in zip(header, units, strict=True) if unit in SI}


def _columns(where: str, header: list[str]) -> tuple[str, ...]:
    """The columns that are read of a CSV file, a heading last; DataError where one is missing, or there twice."""
    time: tuple[str, ...] = ()
    needed: tuple[str, ...] = TRACK
    about = "optional yaw; waypoints: x, y, z"
    headings: list[tuple[str, ...]] = [(name,) for name in HEADINGS]
    if any(name in header for name in WAYPOINTS) and not any(name in header for name in TRACK[1:]):
        needed, about = WAYPOINTS, "optional t and yaw, for waypoints"
        time = TRACK[:1] if "t" in header else ()
    else:
        headings.append(ATTITUDE)
    missing = [name for name in needed if name not in header]
    if missing:
        found = f"found {', '.join(header)}; needed {', '.join(needed)}, {about}"
        raise DataError(f"{where}: no column {', '.join(missing)} in the header ({found})")
    heading = next((names for names in headings if set(names) <= set(header)), ())
    columns = (*needed, *time, *heading)
    for name in columns:
        if header.count(name) > 1:
            raise DataError(f"{where}: {header.count(name)} columns {name} in the header: leave all but one out")
    return columns


def _heading(wheres: list[str], quaternion: np.ndarray) -> np.ndarray:
    """Yaw (k,) (rad) of attitudes (k, 4), w last; DataError where one is not of unit length."""
    lengths = norms(quaternion)
    i = int(np.argmax(np.abs(lengths - 1)))
    if abs(lengths[i] - 1) > 0.01:
        raise DataError(f"{wheres[i]}: the quaternion has length {lengths[i]:.3g}, not 1")
    return heading(quaternion[:, [3, 0, 1, 2]])


def _in_radians(path: Path, name: str, yaw: np.ndarray, points: np.ndarray, t: np.ndarray | None) -> np.ndarray:
    """Headings (k,) without a unit, in rad. Degrees are recognised by steps of 360 where the angle wraps, and by a nose
    that keeps its angle to the course (points: (k, 3)) in degrees and not in radians.

    Raises DataError for angles of more than a turn that say neither and would turn fast: 0 .. 45 in 20 s may be
    degrees, or seven turns.
    """
    size = float(np.abs(yaw).max())
    steps = np.abs(np.diff(yaw))
    if size < FULL_TURN:
        return yaw
    if np.any((steps > 300) & (steps < 420)):
        return np.radians(yaw)
    moves = np.gradient(points[:, :2], axis=0)
    course = np.arctan2(moves[:, 1], moves[:, 0])
    moving = norms(moves) > 0.1 * norms(moves).max()
    along = [abs(np.mean(np.exp(1j * (angle - course)[moving]))) for angle in (np.radians(yaw), yaw)]
    if along[0] > ALONG and along[1] < NOT_ALONG:
        return np.radians(yaw)
    if along[1] > ALONG and along[0] < NOT_ALONG:
        return yaw
    if t is not None and np.abs(yaw).min() < FULL_TURN and np.all(steps < FASTEST * np.diff(t)):
        return yaw
    way = f"name the column {name}_deg if it is in degrees, or wrap it to -pi .. pi if it is in rad"
    raise DataError(f"{path}: {name} reaches {size:.4g}, {size / (2 * np.pi):.3g} turns in rad: {way}")


def _numbers(where: str, row: list[str], header: list[str], columns: tuple[str, ...]) -> list[float]:
    """The named columns of one row as finite numbers; DataError with the line otherwise."""
    if len(row) != len(header):
        raise DataError(f"{where}: {len(row)} values for the {len(header)} columns {' '.join(header)}")
    numbers = []
    for name in columns:
        word = row[header.index(name)]
        try:
            value = float(word)
        except ValueError:
            raise DataError(f"{where}: {name} is {word!r}, not a number") from None
        if not np.isfinite(value):
            raise DataError(f"{where}: {name} is {word.strip()}, not a finite number")
        numbers.append(value)
    return numbers
