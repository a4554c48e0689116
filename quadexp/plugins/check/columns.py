"""Which columns of a table are what: by their names, and of several named alike by what the data obey in any frame.

position, velocity     the one is the derivative of the other, column by column
attitude               four columns of norm one, or roll, pitch, yaw
rate                   |w| = 2 |dq/dt|, which no order, direction or frame of the quaternion changes
acceleration           |f| = |a + g e_up| for one of the six directions of up
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from quadexp.log.runs import period_of
from quadexp.physics.rotation import continuous
from quadexp.physics.state import norms, root_mean_square
from quadexp.physics.vehicle import GRAVITY
from quadexp.plugins.logs.column_names import Groups, groups
from quadexp.plugins.logs.signal import increasing
from quadexp.plugins.logs.signal.windows import attitude_rate, changes, means, weighted, window_samples

MOTION = 0.85  # correlation from which a velocity is taken for the derivative of a position
GRID = 100.0  # Hz
MOST = 8000  # samples looked at


# ------------------------------------------------------------------------------------------------------------- data
class Match(NamedTuple):
    """columns, how well they correlate with what is expected of them, and by what factor they are larger."""

    columns: list[int]
    correlation: float
    gain: float


class Table:
    """Columns of a log on one clock. t: (k,) s, uniform. x: (k, N). times, windows: (n, l), (n, l, N), and means and
    slopes over their halves, (2n, N). named: groups of columns by what their names say, the likeliest first."""

    def __init__(self, names: Sequence[str], t: np.ndarray, data: np.ndarray, clock: int) -> None:
        """The middle of a log of columns (k, N) at times t (k,); empty cells are bridged."""
        later = increasing(t)
        t = t[later]
        named = groups(names)
        data = _unbroken(data[later], named)
        period = max(period_of(t), 1 / GRID)
        samples = int(min(t[-1] - t[0], MOST * period) / period)
        start = 0.5 * (t[0] + t[-1] - samples * period)
        self.t = start + np.arange(samples + 1) * period
        self.x = np.full((samples + 1, data.shape[1]), np.nan)
        for i, column in enumerate(data.T):
            good = np.isfinite(column)
            if good.sum() > 1:
                self.x[:, i] = np.interp(self.t, t[good], column[good])
        rows = window_samples(self.t, np.ones(len(self.t), bool))
        self.times = self.t[rows]
        self.windows = self.x[rows]
        self.means = means(self.times, self.windows)
        self.slopes = changes(self.times, self.windows)
        self.named: Groups = {}
        usable = np.isfinite(self.x).all(axis=0)
        usable[clock] = False
        for quantity, likely in named.items():
            self.named[quantity] = [columns for columns in likely if usable[columns].all()]

    def attitude(self) -> list[int] | None:
        """Four columns that are a unit quaternion that moves."""
        for columns in self.named.get("attitude", []):
            x = self.x[:, columns]
            norm = norms(x)
            unit = np.quantile(np.abs(norm - 1), 0.9) < 0.02 and norm.min() > 1e-3
            moves = np.ptp(x, axis=0).max() > 1e-3
            if unit and moves:
                return columns
        return None

    def derivative(self) -> tuple[list[int], Match] | None:
        """Three columns, and three that are their derivative; None where there are none."""
        matches = []
        for i, p in enumerate(self.named.get("position", [])):
            for k, v in enumerate(self.named.get("velocity", [])):
                slope = self.slopes[:, p]
                mean = self.means[:, v]
                alike = min(_correlation(slope[:, axis], mean[:, axis]) for axis in range(3))
                if alike >= MOTION:
                    gain = float(np.sum(mean * slope) / np.sum(slope**2))
                    matches.append((round(alike - 0.01 * (i + k), 3), p, Match(v, alike, gain)))
        if not matches:
            return None
        _, position, velocity = max(matches, key=itemgetter(0))
        return position, velocity

    def rate(self, q: np.ndarray) -> Match | None:
        """The gyro's columns, by how fast an attitude (n, l, 4) turns, in whatever order it is."""
        turning = weighted(self.times, attitude_rate(self.times, q))
        return self._best("rate", [norms(turning)])

    def acceleration(self, motion: np.ndarray | None) -> Match | None:
        """The accelerometer's columns. motion: acceleration in the log's world, (2n, 3); None: unknown."""
        if motion is None:
            motion = np.zeros((len(self.means), 3))
        ups = GRAVITY * np.vstack([np.eye(3), -np.eye(3)])
        return self._best("acceleration", [norms(motion + up) for up in ups])

    def _best(self, quantity: str, expected: list[np.ndarray]) -> Match | None:
        """The columns named so whose size correlates best with one of the expected sizes, (2n,)."""
        matches = []
        for rank, columns in enumerate(self.named.get(quantity, [])):
            size = norms(self.means[:, columns])
            if np.ptp(self.x[:, columns], axis=0).min() == 0:
                continue
            for y in expected:
                alike = _correlation(size, y)
                gain = root_mean_square(size) / max(root_mean_square(y), 1e-6)
                matches.append((alike - 0.002 * rank, Match(columns, alike, gain)))
        if not matches:
            return None
        _, best = max(matches, key=itemgetter(0))
        return best


def _unbroken(data: np.ndarray, named: Groups) -> np.ndarray:
    """Columns (k, N) whose quaternions keep their side and whose angles do not wrap, to be interpolated."""
    data = data.copy()
    for columns in named.get("attitude", []):
        good = np.isfinite(data[:, columns]).all(axis=1)
        cells = np.ix_(good, columns)
        data[cells] = continuous(data[cells])
    for columns in named.get("euler", []):
        largest = np.nanmax(np.abs(data[:, columns]), initial=0.0)
        turn = 360.0 if largest > 6.4 else 2 * np.pi
        for column in columns:
            good = np.isfinite(data[:, column])
            data[good, column] = np.unwrap(data[good, column], period=turn)
    return data


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Of x and y, (n,); 0 where one does not move."""
    if np.std(x) == 0 or np.std(y) == 0:
        return 0.0
    return float(np.corrcoef(x, y)[0, 1])
