"""Which columns of a table are what: proposed by their names, decided by what the data obey in whatever frame.

position, velocity     the one is the derivative of the other, column by column
attitude               four columns of norm one; three named roll, pitch, yaw
rate                   |w| = 2 |dq/dt|, which no order, direction or frame of the quaternion changes
acceleration           |f| = |a + g e_up| for one of the six directions of up
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from quadexp.log.importers.names import NOT_MEASURED, groups, hint
from quadexp.log.signal.windows import Windows, changes, means, pairs, window_samples
from quadexp.physics.vehicle import GRAVITY

RATE, FORCE, MOTION = 0.5, 0.6, 0.85  # correlations from which columns are taken for a sensor's
GRID = 100.0  # Hz
MOST = 8000  # samples looked at

Groups = dict[str, list[list[int]]]  # quantity -> groups of columns, the likeliest first


class Match(NamedTuple):
    """columns, how well they correlate with what is expected of them, and by what factor they are larger."""

    columns: list[int]
    correlation: float
    gain: float


class Table:
    """Columns of a log on one clock. t: (k,) s, uniform. x: (k, N). times, windows: (n, l), (n, l, N), and means and
    slopes over their halves, (2n, N). named: groups of columns by what their names say; free: columns whose names say
    nothing, which may be anything (one that is named is taken by its name or not at all)."""

    def __init__(self, names: Sequence[str], t: np.ndarray, data: np.ndarray, clock: int) -> None:
        """The middle of a log of columns (k, N) at times t (k,); empty cells are bridged."""
        later = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]])
        t, data = t[later], data[later]
        period = max(float(np.median(np.diff(t))), 1 / GRID)
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
        self.named: Groups = {q: [g for g in found if set(g) <= usable] for q, found in groups(names).items()}
        self.free = {i for i in usable if hint(names[i]) is None and not NOT_MEASURED.search(names[i].lower())}

    def side_by_side(self, width: int, taken: Sequence[int] = ()) -> list[list[int]]:
        """Free columns side by side."""
        left = self.free - set(taken)
        runs = (list(range(i, i + width)) for i in range(self.x.shape[1] - width + 1))
        return [run for run in runs if set(run) <= left]

    @cached_property
    def correlations(self) -> np.ndarray:
        """Of every column's slope with every column's mean, (N, N); 0 where one does not move."""
        a, b = self.slopes - self.slopes.mean(axis=0), self.means - self.means.mean(axis=0)
        size = np.outer(np.sqrt((a * a).sum(axis=0)), np.sqrt((b * b).sum(axis=0)))
        return np.nan_to_num(np.divide(a.T @ b, size, out=np.zeros_like(size), where=size > 0))

    def attitudes(self, taken: Sequence[int]) -> list[list[int]]:
        """Groups of four columns that are a unit quaternion that moves, those named so if there are any."""
        named = [g for g in self.named.get("attitude", []) if self._is_unit(g)]
        return named or [g for g in self.side_by_side(4, taken) if self._is_unit(g)]

    def _is_unit(self, columns: list[int]) -> bool:
        x = self.x[:, columns]
        norm = np.linalg.norm(x, axis=1)
        off = float(np.quantile(np.abs(norm - 1), 0.9))
        return bool(off < 0.02 and norm.min() > 1e-3 and np.ptp(x, axis=0).max() > 1e-3)

    def derivative(self) -> tuple[list[int], Match] | None:
        """Three columns, and three that are their derivative; None where there are none."""
        best, found = -np.inf, None
        named = {name: self.named.get(name, []) for name in ("position", "velocity")}
        for p in [*named["position"], *self.side_by_side(3)]:
            for v in [*named["velocity"], *self.side_by_side(3)]:
                score = min(self.correlations[i, k] for i, k in zip(p, v, strict=True))
                if set(p) & set(v) or score < MOTION:
                    continue
                rank = sum(g.index(x) if x in g else 8 for g, x in zip(named.values(), (p, v), strict=True))
                if score - 0.01 * rank > best + 1e-3:
                    slopes = self.slopes[:, p]
                    gain = float(np.sum(self.means[:, v] * slopes) / np.sum(slopes**2))
                    best, found = score - 0.01 * rank, (p, Match(v, float(score), gain))
        return found

    def rate(self, q: np.ndarray, taken: Sequence[int]) -> Match | None:
        """The gyro's columns, by how fast an attitude (n, l, 4) turns, in whatever order it is."""
        (pair,) = pairs(Windows(self.times, {"q": q, "w": np.zeros((*q.shape[:2], 3))}))
        return self._best("rate", [np.linalg.norm(pair.expected, axis=1)], RATE, taken)

    def acceleration(self, motion: np.ndarray | None, taken: Sequence[int]) -> Match | None:
        """The accelerometer's columns. motion: acceleration in the log's world, (2n, 3); None: unknown."""
        still = np.zeros((len(self.means), 3)) if motion is None else motion
        ups = (sign * axis for axis in np.eye(3) for sign in (1.0, -1.0))
        expected = [np.linalg.norm(still + GRAVITY * up, axis=1) for up in ups]
        return self._best("acceleration", expected, FORCE, taken)

    def _best(self, quantity: str, expected: list[np.ndarray], least: float, taken: Sequence[int]) -> Match | None:
        """The columns named so, or free ones, whose size correlates best with one of the expected sizes, (2n,)."""
        best: tuple[float, Match] | None = None
        named = [g for g in self.named.get(quantity, []) if not set(g) & set(taken)]
        for rank, columns in enumerate(named or self.side_by_side(3, taken)):
            x = np.linalg.norm(self.means[:, columns], axis=1)
            if np.ptp(self.x[:, columns], axis=0).min() == 0:
                continue
            for y in expected:
                both = float(np.std(x) * np.std(y))
                correlation = float(np.mean((x - x.mean()) * (y - y.mean()))) / both if both > 0 else 0.0
                gain = float(np.sqrt(np.mean(x * x) / max(float(np.mean(y * y)), 1e-12)))
                if best is None or correlation - 0.002 * rank > best[0]:
                    best = (correlation - 0.002 * rank, Match(columns, correlation, gain))
        sure = best is not None and (best[1].correlation > least or bool(named))
        return best[1] if best is not None and sure else None

    def alike(self, width: int, taken: Sequence[int]) -> Iterator[list[int]]:
        """Free columns side by side that could be motors: positive, of one size, and moving."""
        for columns in self.side_by_side(width, taken):
            mean, spread = self.means[:, columns].mean(axis=0), self.means[:, columns].std(axis=0)
            if self.means[:, columns].min() < 0 or mean.min() <= 0 or spread.min() < 0.01 * mean.mean():
                continue
            if np.ptp(mean) < 0.4 * mean.mean() and spread.max() < 4 * spread.min():
                yield columns
