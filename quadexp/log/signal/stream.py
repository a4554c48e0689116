"""A signal on its own clock: irregular times, values side by side, gaps.

A gap is a step of the clock longer than `GAP_PERIODS` of the stream's own period (the median step): a few samples lost
on a radio link are bridged, a stretch without data is not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError

GAP_PERIODS = 5.0


class Stream(NamedTuple):
    """t: (k,) s, strictly increasing. values: (k, m)."""

    t: np.ndarray
    values: np.ndarray


def as_stream(stream: Stream | tuple[np.ndarray, np.ndarray], name: str = "stream") -> Stream:
    """The stream with a (k, m) array of floats, rows that are not finite left out.

    Raises DataError where lengths differ, fewer than two rows are left, or the clock does not increase.
    """
    t, values = np.asarray(stream[0], float), np.asarray(stream[1], float)
    values = values[:, None] if values.ndim == 1 else values
    if t.ndim != 1 or len(t) != len(values):
        raise DataError(f"{name}: {t.shape} times for {values.shape} values, one time a row is needed")
    finite = np.isfinite(t) & np.isfinite(values).all(axis=1)
    if not finite.all():
        t, values = t[finite], values[finite]
    if len(t) < 2:
        raise DataError(f"{name}: {len(t)} finite rows, two at least are needed")
    steps = np.diff(t)
    if steps.min() <= 0:
        row = int(np.argmin(steps > 0))
        raise DataError(
            f"{name}: the clock goes from {t[row]:.6f} to {t[row + 1]:.6f} s at row {row}; it must increase"
        )
    return Stream(t, values)


def increasing(t: np.ndarray) -> np.ndarray:
    """Mask of the rows, (k,), that lie later than every row before them: what is left is strictly increasing."""
    t = np.asarray(t, float)
    filled = np.where(np.isfinite(t), t, -np.inf)
    before = np.concatenate([[-np.inf], np.maximum.accumulate(filled)[:-1]])
    return filled > before


def period(t: np.ndarray) -> float:
    """The stream's own period: the median step of its clock (s)."""
    return float(np.median(np.diff(t)))


def stretches(t: np.ndarray, gap: float) -> list[slice]:
    """The rows between the gaps: maximal runs without a step longer than `gap` (s), single rows left out."""
    return [slice(start, stop + 1) for start, stop in runs(np.diff(t) <= gap)]


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """The maximal runs of True in a mask, (start, stop)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
