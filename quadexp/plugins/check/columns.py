"""Which columns of a table are what: by their names, and of several named alike by what the data obey in any frame.

position, velocity     the one is the derivative of the other, column by column
attitude               four columns of norm one, or roll, pitch, yaw
rate                   |w| = 2 |dq/dt|, which no order, direction or frame of the quaternion changes
acceleration           |f| = |a + g e_up| for one of the six directions of up
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from quadexp.log.runs import period_of
from quadexp.physics.rotation import continuous
from quadexp.physics.state import norms
from quadexp.physics.vehicle import GRAVITY
from quadexp.plugins.logs.column_names import Groups, groups
from quadexp.plugins.logs.signal import increasing
from quadexp.plugins.logs.signal.windows import Windows, changes, means, pairs, window_samples

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
        t, data = t[later], data[later]
        named = groups(names)
        data = _unbroken(data, named)
        period = max(period_of(t), 1 / GRID)
        length = min(t[-1] - t[0], MOST * period)
        self.t = 0.5 * (t[0] + t[-1] - length) + np.arange(int(length / period) + 1) * period
        self.x = np.full((len(self.t), data.shape[1]), np.nan)
        for i, column in enumerate(data.T):
            good = np.isfinite(column)
            if good.sum() > 1:
                self.x[:, i] = np.interp(self.t, t[good], column[good])
        rows = window_samples(self.t, np.ones(len(self.t), bool))
        self.times, self.windows = self.t[rows], self.x[rows]
        self.means, self.slopes = means(self.times, self.windows), changes(self.times, self.windows)
        usable = {i for i in range(len(names)) if i != clock and np.isfinite(self.x[:, i]).all()}
        self.named = {q: [g for g in each if set(g) <= usable] for q, each in named.items()}

    def attitude(self) -> list[int] | None:
        """Four columns that are a unit quaternion that moves."""
        return next((columns for columns in self.named.get("attitude", []) if self._is_unit(columns)), None)

    def _is_unit(self, columns: list[int]) -> bool:
        x = self.x[:, columns]
        norm = norms(x)
        off = float(np.quantile(np.abs(norm - 1), 0.9))
        return bool(off < 0.02 and norm.min() > 1e-3 and np.ptp(x, axis=0).max() > 1e-3)

    def derivative(self) -> tuple[list[int], Match] | None:
        """Three columns, and three that are their derivative; None where there are none."""
        best, match = -np.inf, None
        for (i, p), (k, v) in product(*(enumerate(self.named.get(name, [])) for name in ("position", "velocity"))):
            slopes, means_ = self.slopes[:, p], self.means[:, v]
            score = min(_correlation(a, b) for a, b in zip(slopes.T, means_.T, strict=True))
            if score >= MOTION and score - 0.01 * (i + k) > best + 1e-3:
                gain = float(np.sum(means_ * slopes) / np.sum(slopes**2))
                best, match = score - 0.01 * (i + k), (p, Match(v, score, gain))
        return match

    def rate(self, q: np.ndarray) -> Match | None:
        """The gyro's columns, by how fast an attitude (n, l, 4) turns, in whatever order it is."""
        (pair,) = pairs(Windows(self.times, {"q": q, "w": np.zeros((*q.shape[:2], 3))}))
        return self._best("rate", [norms(pair.expected)])

    def acceleration(self, motion: np.ndarray | None) -> Match | None:
        """The accelerometer's columns. motion: acceleration in the log's world, (2n, 3); None: unknown."""
        still = np.zeros((len(self.means), 3)) if motion is None else motion
        ups = (sign * axis for axis in np.eye(3) for sign in (1.0, -1.0))
        return self._best("acceleration", [norms(still + GRAVITY * up) for up in ups])

    def _best(self, quantity: str, expected: list[np.ndarray]) -> Match | None:
        """The columns named so whose size correlates best with one of the expected sizes, (2n,)."""
        matches = []
        for rank, columns in enumerate(self.named.get(quantity, [])):
            x = norms(self.means[:, columns])
            if np.ptp(self.x[:, columns], axis=0).min() == 0:
                continue
            for y in expected:
                gain = float(np.sqrt(np.mean(x * x) / max(float(np.mean(y * y)), 1e-12)))
                matches.append((rank, Match(columns, _correlation(x, y), gain)))
        return max(matches, key=lambda each: each[1].correlation - 0.002 * each[0], default=(0, None))[1]


def _unbroken(data: np.ndarray, named: Groups) -> np.ndarray:
    """Columns (k, N) whose quaternions keep their side and whose angles do not wrap, to be interpolated."""
    data = data.copy()
    for columns in named.get("attitude", []):
        good = np.isfinite(data[:, columns]).all(axis=1)
        data[np.ix_(good, columns)] = continuous(data[np.ix_(good, columns)])
    for columns in named.get("euler", []):
        angles = data[:, columns]
        turn = 360.0 if np.nanmax(np.abs(angles), initial=0.0) > 6.4 else 2 * np.pi
        for column in columns:
            good = np.isfinite(data[:, column])
            data[good, column] = np.unwrap(data[good, column], period=turn)
    return data


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Of x and y, (n,); 0 where one does not move."""
    both = float(np.std(x) * np.std(y))
    return float(np.mean((x - x.mean()) * (y - y.mean()))) / both if both > 0 else 0.0
