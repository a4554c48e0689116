"""Weights that a hypothesis of age, dead time and lag gives to the last commands, or to the last readings.

A command that was sent a time x ago, and waits and lags (s), has been answered by 1 - exp(-x / lag) of its step since
it began to act. Of the response to a step, x after it acts,

    once(x) = x - lag (1 - exp(-x / lag)),    twice(x) = x^2 / 2 - lag once(x)        x > 0, else 0

are the integrals. Grids are given as the bytes of their arrays (s): ages (a,), totals (t,), lags (l,); a total is a
dead time and the lag.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from quadexp.control.auto.bank import DEAD_TIME
from quadexp.control.delivered import INSTANT

LEVEL, READ = 1e4, 1e-3  # variances of where a force begins, and of what readings are off by, in those of a step


@lru_cache(maxsize=64)
def command_weights(period: float, count: int, totals: bytes, lags: bytes, span: float) -> np.ndarray:
    """Weights (t, l, m) on m = count commands, the newest first, as of control.delivered: of the mean thrust over the
    last span (s)."""
    lag = np.frombuffer(lags)
    wait = np.maximum(np.frombuffer(totals)[:, None] - lag, 0.0)
    passed = _passed(period * np.arange(1, count + 1) - wait[..., None], lag[:, None], span)
    passed[..., -1] = 1.0
    passed[..., 1:] -= passed[..., :-1].copy()
    passed.flags.writeable = False  # it is shared
    return passed


@lru_cache(maxsize=16)
def reading_weights(
    period: float, count: int, commands: int, ages: bytes, totals: bytes, lags: bytes, span: float
) -> np.ndarray:
    """Weights (a, p, 1 + 3 count) on y and phi of the velocity, see bank, for the `possible` pairs of total and lag: 1,
    and minus those on readings of the force, the newest first: along the thrust, of its mean over a period that ended
    an age ago, and of its first moment about the middle, over the period; across the thrust, of its mean.

    Between two readings a force that jumps with each command goes another way than along a straight line, and the mean
    of a line would be of another time, by half a period at most. So it is what is likeliest of a force whose commands
    make a step of their own, all alike, in each period, and which follows them after dead time and lag: with steps s,
    readings H s and the mean M s it is M H' (H H')^-1 of the readings. Each is itself a mean over a span (s).
    """
    age, total, lag = map(np.frombuffer, (ages, totals, lags))
    t, k = possible(total, lag)
    wait = np.maximum(total[t] - lag[k], 0.0)[:, None]
    passed = _passed(period * np.arange(2 - count, commands + 1) - wait, lag[k, None], span)
    H = passed[:, np.arange(count)[::-1, None] + np.arange(commands)]

    times, places = np.unique(np.round(age[:, None] + total, 9), return_inverse=True)  # many sums are alike
    since = period * np.arange(commands + 1) - (times[:, None] - lag)[..., None]
    once = _once(since, lag[:, None])
    twice = np.maximum(since, 0.0) ** 2 / 2 - lag[:, None] * once
    M = np.empty((*once.shape[:2], 2, commands))  # of the mean, and of the moment
    M[..., 0, :] = (once[..., 1:] - once[..., :-1]) / period
    M[..., 1, :] = (once[..., 1:] + once[..., :-1]) / 2 / period - (twice[..., 1:] - twice[..., :-1]) / period**2

    M = M[places.reshape(len(age), -1)[:, t].T, k[:, None]]  # (p, a, 2, commands)
    likely = M.reshape(len(t), -1, commands) @ H.mT
    likely[:, ::2] += LEVEL
    likely = likely @ np.linalg.inv(H @ H.mT + LEVEL + READ * np.eye(count))
    weights = np.ones((len(age), len(t), 1 + 3 * count))
    weights[..., 1 : 1 + 2 * count] = -likely.reshape(len(t), len(age), -1).swapaxes(0, 1)
    weights[..., 1 + 2 * count :] = -mean_weights(age - span / 2, period, count)[:, None]
    weights.flags.writeable = False  # it is shared
    return weights


def mean_weights(ages: np.ndarray, period: float, count: int) -> np.ndarray:
    """Weights (a, count) on readings, the newest first, of their mean over a period that ended an age (a,) ago, linear
    between them; a little beyond the newest, too."""
    weights, k, each = np.zeros((len(ages), count)), (ages / period + 1e-9).astype(int), np.arange(len(ages))
    r = ages / period - k
    for i, weight in enumerate(((1 - r) ** 2 / 2, 0.5 + r - r * r, r * r / 2)):
        weights[each, k + i] = weight
    return weights


def possible(totals: np.ndarray, lags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pairs of total (t,) and lag (l,) (s) that leave a dead time: where they stand in these, (p,) each."""
    waits = totals[:, None] - lags
    t, k = np.nonzero((waits > -INSTANT) & (waits < DEAD_TIME + INSTANT))
    return t, k


def _once(since: np.ndarray, lag: np.ndarray) -> np.ndarray:
    """Integral of the response to a step that acts since a time (s)."""
    x = np.maximum(since, 0.0)
    integral: np.ndarray = x + lag * (np.exp(x / -np.maximum(lag, INSTANT)) - 1)
    return integral


def _passed(since: np.ndarray, lag: np.ndarray, span: float) -> np.ndarray:
    """Share of a step that has passed, in the mean over the last span (s)."""
    if span > INSTANT:
        return (_once(since, lag) - _once(since - span, lag)) / span
    return 1 - np.exp(np.maximum(since, 0.0) / -np.maximum(lag, INSTANT))
