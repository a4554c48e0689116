"""Finite impulse responses of the hypotheses: weights on the last commands and readings, the newest first.

A command waits for the dead time d, then the thrust follows with a first-order lag l. With the step response
s(x) = 1 - exp(-x / l) for x > 0, a command that was replaced after a period T has the weight

    h_j = s((j + 1) T - d) - s(j T - d),        the oldest that is kept counts for all before it,

or the same with the mean of s over a span. Behind its first ones, the head, weights fall by exp(-T / l) each: h is a
head and a tail, and a sum over the tail follows from that of one weight less.
"""

from __future__ import annotations

import math
from typing import Any

from quadexp.compile.symbolic import ca
from quadexp.control.delivered import INSTANT


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
    """h' y and h' M h, (k, l), of the weights h of each total (k,) and lag (l,), without these weights: y (1, m),
    M (m, m)."""
    m, lags, totals = M.size1(), lag.numel(), total.numel()
    heads = math.ceil(span / period - INSTANT) + 1
    waits = ca.fmax(ca.repmat(total, 1, lags) - ca.repmat(lag.T, totals, 1), 0)
    lag = ca.fmax(lag, INSTANT).T
    falls = ca.exp(-period / lag)
    rows = ca.vertcat(y, M)
    tail, square = ca.repmat(rows[:, m - 1], 1, lags) / ca.repmat(1 - falls, m + 1, 1), M[m - 1, m - 1] / (1 - falls) ** 2
    of_y, squares, beside = [tail[0, :]], [square], [[] for _ in range(heads)]

    def put_beside(j: int) -> None:
        for k, of in enumerate(beside):
            row = j - heads + k
            of.append(tail[1 + row, :] if row >= 0 else ca.DM.zeros(1, lags))

    put_beside(m - 1)
    for j in reversed(range(m - 1)):
        square = M[j, j] + 2 * falls * tail[1 + j, :] + falls**2 * square
        tail = ca.repmat(rows[: 1 + j, j], 1, lags) + ca.repmat(falls, 1 + j, 1) * tail[: 1 + j, :]
        of_y.append(tail[0, :])
        squares.append(square)
        put_beside(j)
    of_y, squares, *beside = (ca.vec(ca.vertcat(*reversed(of))) for of in (of_y, squares, *beside))

    first = ca.floor(waits / period)
    lag = ca.repmat(lag, totals, 1)
    responses = [step_response((first + 1 + k) * period - waits, lag, span) for k in range(heads + 1)]
    h = [responses[0], *(after - before for before, after in zip(responses, responses[1:], strict=False))]
    first = ca.vec(first)
    behind = first + heads + m * ca.DM([i for i in range(lags) for _ in range(totals)])

    def taken(table: Any, at: Any) -> Any:
        return ca.reshape(table[at], totals, lags)

    c = h[heads]
    cross, whole = c * taken(of_y, behind), c**2 * taken(squares, behind)
    for k in range(heads):
        cross = cross + h[k] * taken(y.T, first + k)
        whole = whole + 2 * c * h[k] * taken(beside[k], behind)
        for i in range(heads):
            whole = whole + h[k] * h[i] * taken(ca.vec(M), first + k + m * (first + i))
    return cross, whole


def reading_weights(period: float, count: int, age: Any) -> Any:
    """Weights (k, count) on readings a period apart of their mean over a period that ended an age (k,) (s) ago, linear
    between them (trapezoid rule), and a little beyond the newest, too."""
    whole = ca.fmax(ca.floor(age / period + INSTANT), 0)
    part = age / period - whole
    places, weights = ca.repmat(ca.DM(range(count)).T, age.numel(), 1), 0
    for i, weight in enumerate(((1 - part) ** 2 / 2, 0.5 + part - part**2, part**2 / 2)):
        weights = weights + ca.repmat(weight, 1, count) * (places == ca.repmat(whole + i, 1, count))
    return weights
