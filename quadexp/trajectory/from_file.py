"""Trajectory from a file: recorded or designed positions, interpolated with continuous derivatives up to snap.

Two formats, told apart by the first line that is not a comment:

    CSV    a header with the columns t, p_x, p_y, p_z and, if there, yaw (s, m, rad; world ENU); others are ignored
    TUM    t x y z qx qy qz qw, separated by blanks, no header (s, m; quaternion body to world)

Interpolation by a degree-7 spline through every row (continuous up to the sixth derivative, not-a-knot ends), so a
recorded track wants to be smooth: noise in the rows grows by dt^-4 in the snap. Time starts at the first row.
The yaw of a TUM file is that of the reference's convention, y_body level with (-sin yaw, cos yaw, 0).
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError, UsageError
from quadexp.trajectory.base import N_DERIVATIVES, FlatOutput, flat_output_held, hold_outside, sampled_peak_speed

DEGREE = 7
MIN_ROWS = DEGREE + 1
CSV_COLUMNS = ("t", "p_x", "p_y", "p_z")
TUM_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")


@dataclass(frozen=True, kw_only=True)
class FileTrajectory:
    """The track in a CSV or TUM file; it is read when first used.

    path: file. Raises UsageError where there is no such file, DataError (with the line number) where it is not a track.
    """

    path: str

    def __post_init__(self) -> None:
        if not Path(self.path).is_file():
            raise UsageError(f"trajectory.path: there is no file {str(self.path)!r}")

    @property
    def duration(self) -> float:
        return self._track[0]

    @cached_property
    def peak_speed(self) -> float:
        return sampled_peak_speed(self)

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output."""
        duration, derivatives = self._track
        t, inside = hold_outside(t, duration)
        values = np.stack([derivative(t) for derivative in derivatives], axis=1)
        return flat_output_held(values[:, :, :3].copy(), values[:, :3, 3].copy(), inside)

    @cached_property
    def _track(self) -> tuple[float, tuple[BSpline, ...]]:
        """Duration (s) and the splines of [x, y, z, yaw] with their derivatives up to the fourth."""
        track = read_track(Path(self.path))
        t = track[:, 0] - track[0, 0]
        spline = make_interp_spline(t, track[:, 1:], k=DEGREE)
        return float(t[-1]), tuple(spline.derivative(order) if order else spline for order in range(N_DERIVATIVES))


def read_track(path: Path) -> np.ndarray:
    """Rows [t, x, y, z, yaw] of a CSV or TUM file, (k, 5) (s, m, rad), yaw unwrapped.

    Raises DataError with the line number for a missing column, a value that is no finite number, time that does not
    increase, or fewer than 8 rows.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not a readable text file ({error})") from None
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if not lines:
        raise DataError(f"{path}: no rows (a track needs at least {MIN_ROWS})")
    if "," in lines[0][1]:
        header = [name.strip() for name in next(csv.reader([lines[0][1]]))]
        missing = [name for name in CSV_COLUMNS if name not in header]
        if missing:
            raise DataError(
                f"{path}, line {lines[0][0]}: no column {', '.join(missing)} in the header"
                f" (found {', '.join(header)}; needed {', '.join(CSV_COLUMNS)}, optional yaw)"
            )
        lines = lines[1:]
        columns: tuple[str, ...] = (*CSV_COLUMNS, "yaw") if "yaw" in header else CSV_COLUMNS
        rows = [(i, next(csv.reader([line]))) for i, line in lines]
    else:
        header, columns = list(TUM_COLUMNS), TUM_COLUMNS
        rows = [(i, line.split()) for i, line in lines]
    values = np.array([_numbers(path, i, row, header, columns) for i, row in rows]).reshape(len(rows), len(columns))
    if len(values) < MIN_ROWS:
        raise DataError(f"{path}: {len(values)} rows, a track needs at least {MIN_ROWS}")
    for (i, _), (before, now) in zip(rows[1:], pairwise(values[:, 0]), strict=True):
        if now <= before:
            raise DataError(f"{path}, line {i}: t = {now:g} s does not come after {before:g} s, time must increase")
    if columns == TUM_COLUMNS:
        lengths = np.linalg.norm(values[:, 4:], axis=1)
        if np.any(np.abs(lengths - 1) > 0.01):
            i = int(np.argmax(np.abs(lengths - 1)))
            raise DataError(f"{path}, line {rows[i][0]}: the quaternion has length {lengths[i]:.3g}, not 1")
        y_body = Rotation.from_quat(values[:, 4:]).as_matrix()[:, :, 1]
        yaw = np.arctan2(-y_body[:, 0], y_body[:, 1])
    else:
        yaw = values[:, 4] if "yaw" in columns else np.zeros(len(values))
    return np.column_stack([values[:, :4], np.unwrap(yaw)])


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
