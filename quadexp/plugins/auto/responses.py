"""Finite impulse responses of the hypotheses: weights on the last commands and readings, the newest first.

A command waits for the dead time d, then the thrust follows with a first-order lag l. With the step response
s(x) = 1 - exp(-x / l) for x > 0, a command that was replaced after a period T has the weight

    h_j = s((j + 1) T - d) - s(j T - d),        the oldest that is kept counts for all before it,

or the same with the mean of s over a span. posterior.c has sums over these weights without having the weights: behind
its first ones, the head, they fall by exp(-T / l) each, and a sum over this tail follows from that of one weight less.
"""

from __future__ import annotations

import numpy as np

from quadexp.plugins.remedies.sent_commands import INSTANT, NO_LAG


def step_response(x: np.ndarray, lag: np.ndarray, span: float) -> np.ndarray:
    """Of a first-order lag (s) at x (s), or its mean over the span (s) before."""
    if span <= INSTANT:
        response: np.ndarray = -np.expm1(-np.maximum(x, 0) / lag)
        return response
    return (_integral(x, lag) - _integral(x - span, lag)) / span


def _integral(x: np.ndarray, lag: np.ndarray) -> np.ndarray:
    """Of the step response."""
    x = np.maximum(x, 0)
    return x + lag * np.expm1(-x / lag)


def command_weights(period: float, count: int, total: np.ndarray, lag: np.ndarray, span: float) -> np.ndarray:
    """Weights (k, count) of totals = dead time + lag, (k,), and lags, (k,) (s), of the mean over `span` (s)."""
    wait = np.maximum(total - lag, 0)
    elapsed = period * np.arange(1, count) - wait[:, None]
    response = step_response(elapsed, np.maximum(lag, NO_LAG)[:, None], span)
    return np.diff(response, axis=1, prepend=0, append=1)


def reading_weights(period: float, count: int, age: np.ndarray) -> np.ndarray:
    """Weights (k, count) on readings a period apart of their mean over a period that ended an age (k,) (s) ago, linear
    between them (trapezoid rule), and a little beyond the newest, too."""
    whole = np.maximum(np.floor(age / period + INSTANT), 0).astype(int)
    part = age / period - whole
    weights = np.zeros((len(age), count))
    rows = np.arange(len(age))
    weights[rows, whole] = (1 - part) ** 2 / 2
    weights[rows, whole + 1] = 0.5 + part - part**2
    weights[rows, whole + 2] = part**2 / 2
    return weights
