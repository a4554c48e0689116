"""Positions in files: sampled tracks and waypoints, distinguished by the file's first line.

    CSV track      a header with the columns t, p_x, p_y, p_z and, if there, yaw (s, m, rad; world ENU); 8 rows or more
    CSV waypoints  a header with the columns x, y, z and, if there, t and yaw (m, s, rad; world ENU); 2 rows or more
    TUM track      t x y z qx qy qz qw, separated by blanks, no header (s, m; quaternion body to world)

Other columns, and lines that begin with #, are ignored. The yaw of a TUM file follows the convention of the reference:
y_body level with (-sin yaw, cos yaw, 0).
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError

MIN_ROWS = 8  # of a track, needed by the degree-7 spline
MIN_POINTS, MAX_POINTS = 2, 200
CSV_COLUMNS = ("t", "p_x", "p_y", "p_z")
WAYPOINT_COLUMNS = ("x", "y", "z")
TUM_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class Positions:
    """Content of a file. sampled: True for a track, False for waypoints.

    times: (k,), s; None for waypoints without times. points: (k, 3), world (m). yaw: (k,), unwrapped (rad), or None.
    """

    sampled: bool
    times: np.ndarray | None
    points: np.ndarray
    yaw: np.ndarray | None


def read_positions(path: Path) -> Positions:
    """The rows of a CSV or TUM file.

    Raises DataError with the line number for a missing column, a value that is not a finite number, time that does not
    increase, repeated waypoints without times, or too few or too many rows.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not a readable text file ({error})") from None
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if not lines:
        raise DataError(f"{path}: no rows (a track needs at least {MIN_ROWS}, waypoints {MIN_POINTS})")
    if "," not in lines[0][1]:
        return _tum(path, [(i, line.split()) for i, line in lines])
    header = [name.strip() for name in next(csv.reader([lines[0][1]]))]
    rows = [(i, next(csv.reader([line]))) for i, line in lines[1:]]
    if any(name in header for name in WAYPOINT_COLUMNS) and not any(name in header for name in CSV_COLUMNS[1:]):
        return _waypoints(path, lines[0][0], header, rows)
    _require_columns(path, lines[0][0], header, CSV_COLUMNS, "optional yaw; waypoints: x, y, z, optional t and yaw")
    columns = (*CSV_COLUMNS, "yaw") if "yaw" in header else CSV_COLUMNS
    values = _values(path, rows, header, columns)
    if len(values) < MIN_ROWS:
        raise DataError(
            f"{path}: {len(values)} rows, a track needs at least {MIN_ROWS}; for waypoints name the columns x, y, z"
        )
    _require_increasing_time(path, rows, values[:, 0])
    return Positions(True, values[:, 0], values[:, 1:4], np.unwrap(values[:, 4]) if "yaw" in columns else None)


def _tum(path: Path, rows: list[tuple[int, list[str]]]) -> Positions:
    values = _values(path, rows, list(TUM_COLUMNS), TUM_COLUMNS)
    if len(values) < MIN_ROWS:
        raise DataError(f"{path}: {len(values)} rows, a track needs at least {MIN_ROWS}")
    _require_increasing_time(path, rows, values[:, 0])
    lengths = np.linalg.norm(values[:, 4:], axis=1)
    if np.any(np.abs(lengths - 1) > 0.01):
        i = int(np.argmax(np.abs(lengths - 1)))
        raise DataError(f"{path}, line {rows[i][0]}: the quaternion has length {lengths[i]:.3g}, not 1")
    y_body = Rotation.from_quat(values[:, 4:]).as_matrix()[:, :, 1]
    return Positions(True, values[:, 0], values[:, 1:4], np.unwrap(np.arctan2(-y_body[:, 0], y_body[:, 1])))


def _waypoints(path: Path, line: int, header: list[str], rows: list[tuple[int, list[str]]]) -> Positions:
    _require_columns(path, line, header, WAYPOINT_COLUMNS, "optional t and yaw, for waypoints")
    columns = (*WAYPOINT_COLUMNS, *(name for name in ("t", "yaw") if name in header))
    values = dict(zip(columns, _values(path, rows, header, columns).T, strict=True))
    points = np.column_stack([values[name] for name in WAYPOINT_COLUMNS])
    if not MIN_POINTS <= len(points) <= MAX_POINTS:
        raise DataError(
            f"{path}: {len(points)} waypoints, {MIN_POINTS} to {MAX_POINTS} are allowed; for a sampled track name the"
            f" columns {', '.join(CSV_COLUMNS)}"
        )
    if "t" in values:
        _require_increasing_time(path, rows, values["t"])
    else:
        for (i, _), before, now in zip(rows[1:], points, points[1:], strict=False):
            if np.array_equal(before, now):
                raise DataError(
                    f"{path}, line {i}: the same point as in the previous row; add a column t to stay there"
                )
    yaw = np.unwrap(values["yaw"]) if "yaw" in values else None
    return Positions(False, values.get("t"), points, yaw)


def _require_columns(path: Path, line: int, header: list[str], needed: tuple[str, ...], optional: str) -> None:
    missing = [name for name in needed if name not in header]
    if missing:
        raise DataError(
            f"{path}, line {line}: no column {', '.join(missing)} in the header"
            f" (found {', '.join(header)}; needed {', '.join(needed)}, {optional})"
        )


def _require_increasing_time(path: Path, rows: list[tuple[int, list[str]]], t: np.ndarray) -> None:
    for (i, _), (before, now) in zip(rows[1:], pairwise(t), strict=True):
        if now <= before:
            raise DataError(f"{path}, line {i}: t = {now:g} s is not after {before:g} s, time must increase")


def _values(path: Path, rows: list[tuple[int, list[str]]], header: list[str], columns: tuple[str, ...]) -> np.ndarray:
    """The named columns of all rows, (k, columns)."""
    return np.array([_numbers(path, i, row, header, columns) for i, row in rows]).reshape(len(rows), len(columns))


def _numbers(path: Path, line: int, row: list[str], header: list[str], columns: tuple[str, ...]) -> list[float]:
    """The named columns of one row as finite numbers; DataError with the line otherwise."""
    if len(row) != len(header):
        raise DataError(f"{path}, line {line}: {len(row)} values for the {len(header)} columns {' '.join(header)}")
    numbers = []
    for name in columns:
        word = row[header.index(name)]
        try:
            value = float(word)
        except ValueError:
            raise DataError(f"{path}, line {line}: {name} is {word!r}, not a number") from None
        if not np.isfinite(value):
            raise DataError(f"{path}, line {line}: {name} is {word.strip()}, not a finite number")
        numbers.append(value)
    return numbers
