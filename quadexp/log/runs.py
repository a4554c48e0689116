"""Runs of samples: the period of a clock, maximal runs of a mask."""

from __future__ import annotations

import numpy as np


def period_of(t: np.ndarray) -> float:
    """The stream's own period: the median step of its clock (s)."""
    return float(np.median(np.diff(t)))


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """The maximal runs of True in a mask, (start, stop)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def longest(mask: np.ndarray) -> tuple[int, int]:
    """The longest of them."""
    return max(runs(mask), key=lambda run: run[1] - run[0])
