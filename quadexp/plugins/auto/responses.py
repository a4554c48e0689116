"""Finite impulse responses of the hypotheses: weights on the last commands and readings, the newest first.

A command waits for the dead time d, then the thrust follows with a first-order lag l. With the step response
s(x) = 1 - exp(-x / l) for x > 0, a command that was replaced after a period T has the weight

    h_j = s((j + 1) T - d) - s(j T - d),        the oldest that is kept counts for all before it,

or the same with the mean of s over a span.
"""

from __future__ import annotations

import numpy as np

from quadexp.control.delivered import INSTANT


def command_weights(period: float, count: int, total: np.ndarray, lag: np.ndarray, span: float) -> np.ndarray:
    """Weights (k, count) of hypotheses (k,) of total = dead time + lag and of lag (s), of the mean over `span` (s)."""
    elapsed = period * np.arange(1, count + 1) - np.maximum(total - lag, 0.0)[:, None]
    lag = np.maximum(lag, INSTANT)[:, None]
    if span > INSTANT:
        response = (_integral(elapsed, lag) - _integral(elapsed - span, lag)) / span
    else:
        response = -np.expm1(-np.maximum(elapsed, 0.0) / lag)
    response[:, -1] = 1.0
    return np.diff(response, axis=1, prepend=0.0)


def _integral(elapsed: np.ndarray, lag: np.ndarray) -> np.ndarray:
    """Of the step response over `elapsed` (s)."""
    x = np.maximum(elapsed, 0.0)
    integral: np.ndarray = x + lag * np.expm1(-x / lag)
    return integral


def reading_weights(period: float, count: int, age: np.ndarray) -> np.ndarray:
    """Weights (k, count) on readings a period apart of their mean over a period that ended an age (k,) (s) ago, linear
    between them (trapezoid rule), and a little beyond the newest, too."""
    weights, row = np.zeros((len(age), count)), np.arange(len(age))
    whole = (age / period + INSTANT).astype(int)
    part = age / period - whole
    for i, weight in enumerate(((1 - part) ** 2 / 2, 0.5 + part - part**2, part**2 / 2)):
        weights[row, whole + i] = weight
    return weights
