"""Finite impulse responses of the hypotheses: weights on the last commands and readings, the newest first.

A command waits for the dead time d, then the thrust follows with a first-order lag l. With the step response
s(x) = 1 - exp(-x / l) for x > 0, a command that was replaced after a period T has the weight

    h_j = s((j + 1) T - d) - s(j T - d),        the oldest that is kept counts for all before it,

or the same with the mean of s over a span. Behind its first ones, the head, weights fall by exp(-T / l) each: h is a
head and a tail, and a sum over the tail follows from that of one weight less.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.plugins.remedies.sent_commands import INSTANT

HEAD = 2  # weights; a span is at most a period


def step_response(x: Any, lag: Any, span: float) -> Any:
    """Of a first-order lag (s) at x (s), or its mean over the span (s) before."""
    if span <= INSTANT:
        return -ca.expm1(-ca.fmax(x, 0) / lag)

    def integral(x: Any) -> Any:
        x = ca.fmax(x, 0)
        return x + lag * ca.expm1(-x / lag)

    return (integral(x) - integral(x - span)) / span


def command_weights(period: float, count: int, total: Any, lag: Any, span: float) -> Any:
    """Weights (count,) of a total = dead time + lag and a lag (s), of the mean over `span` (s)."""
    elapsed = period * ca.DM(range(1, count)) - ca.fmax(total - lag, 0)
    response = step_response(elapsed, ca.fmax(lag, INSTANT), span)
    return ca.vertcat(response, 1) - ca.vertcat(0, response)


def tails(y: Any, M: Any, period: float, total: Any, lag: Any, span: float) -> tuple[Any, Any]:
    """h' y and h' M h, (k, l), of the weights h of each total (k,) and lag (l,): y (1, m), M (m, m)."""
    m, lags, totals = M.size1(), lag.numel(), total.numel()
    waits = ca.fmax(ca.repmat(total, 1, lags) - ca.repmat(lag.T, totals, 1), 0)
    lag = ca.fmax(lag, INSTANT).T
    of_y, squares, *beside = ca.vertsplit(tail_function(m, lags)(y, M, ca.exp(-period / lag)))

    first = ca.floor(waits / period)
    lag = ca.repmat(lag, totals, 1)
    responses = [step_response((first + 1 + k) * period - waits, lag, span) for k in range(HEAD + 1)]
    h = [responses[0], *(after - before for before, after in zip(responses, responses[1:], strict=False))]
    first = ca.vec(first)
    behind = ca.DM(np.repeat(range(lags), totals)) + lags * (m - 1 - first - HEAD)

    def taken(table: Any, at: Any) -> Any:
        return ca.reshape(table[at], totals, lags)

    c = h[HEAD]
    cross, whole = c * taken(of_y, behind), c**2 * taken(squares, behind)
    for k in range(HEAD):
        cross = cross + h[k] * taken(y.T, first + k)
        whole = whole + 2 * c * h[k] * taken(beside[k], behind)
        for i in range(HEAD):
            whole = whole + h[k] * h[i] * taken(ca.vec(M), first + k + m * (first + i))
    return cross, whole


@cache
def tail_function(m: int, lags: int) -> ca.Function:
    """Sums with the tail g that begins at each j, g_i = falls^(i - j), and counts for all behind the last: g' y,
    g' M g, and (M g)_i for the HEAD weights i before j, (2 + HEAD, l m), lags within j, the last j first."""
    y, M, falls = ca.MX.sym("y", 1, m), ca.MX.sym("M", m, m), ca.MX.sym("falls", 1, lags)
    # a column for each j: y_j, then M_ij for i = j, j - 1, ..
    before = [[j - d + m * j if d <= j else 0 for j in range(m)] for d in range(m)]
    columns = ca.vertcat(y, *(M[row].T for row in before))
    state, column = ca.MX.sym("state", m + 2, lags), ca.MX.sym("column", m + 1)
    square = column[1] + 2 * falls * state[3, :] + falls**2 * state[1, :]
    shifted = ca.vertcat(state[0, :], state[3:, :], ca.DM.zeros(1, lags))
    sums = ca.repmat(column, 1, lags) + ca.repmat(falls, m + 1, 1) * shifted
    after = ca.vertcat(sums[0, :], square, sums[1:, :])
    step = ca.Function("tail_step", [state, column, falls], [after])
    last = ca.repmat(columns[:, m - 1], 1, lags) / ca.repmat(1 - falls, m + 1, 1)
    now = ca.vertcat(last[0, :], columns[1, m - 1] / (1 - falls) ** 2, last[1:, :])
    rows = [0, 1, *(2 + HEAD - k for k in range(HEAD))]
    found = [now[rows, :]]
    for j in reversed(range(m - 1)):
        now = step(now, columns[:, j], falls)
        found.append(now[rows, :])
    return ca.Function("tails", [y, M, falls], [ca.horzcat(*found)])


def reading_weights(period: float, count: int, age: Any) -> Any:
    """Weights (k, count) on readings a period apart of their mean over a period that ended an age (k,) (s) ago, linear
    between them (trapezoid rule), and a little beyond the newest, too."""
    whole = ca.fmax(ca.floor(age / period + INSTANT), 0)
    part = age / period - whole
    places, weights = ca.repmat(ca.DM(range(count)).T, age.numel(), 1), 0
    for i, weight in enumerate(((1 - part) ** 2 / 2, 0.5 + part - part**2, part**2 / 2)):
        weights = weights + ca.repmat(weight, 1, count) * (places == ca.repmat(whole + i, 1, count))
    return weights
