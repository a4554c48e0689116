"""A linear control loop, cut at its commands: how its deviations grow, and its gain.

    z' = A z + B v,    u = C z            the plant gets v, the controller sends u

There is an A, B and C for each of the instants after which the loop is the same again: where parts run at several
rates, and where sensors do. Numbers that do not lead from v back to u, such as covariances and counters, are no part of
the loop. plugins.margins.linearised makes it of what flies.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

NOTHING = 1e-5  # a derivative that is none
DIGITS = 9  # of derivatives that are equal
FIXED = 1e-6  # an eigenvalue that differs by less is the same
ORDER = 4  # of the response to a command over a few periods


class Phase(NamedTuple):
    """A (m, m), B (m, n) and C (n, m) of one instant, see the module."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray


class LinearLoop:
    """The linear loop over some instants, without what is not in the loop.

    phases: of the instants. period: s, between two of them. smooth: which of z follow a command from zero on, as the
    vehicle does, (m,); direct: which follow it at once, as an accelerometer does.
    """

    def __init__(self, phases: list[Phase], period: float, smooth: np.ndarray, direct: np.ndarray) -> None:
        from_command = sum(np.abs(B).sum(axis=1) for _, B, _ in phases) > NOTHING
        to_command = sum(np.abs(C).sum(axis=0) for _, _, C in phases) > NOTHING
        follows = np.where(sum(np.abs(A) for A, _, _ in phases) > NOTHING, 1.0, 0.0)
        kept = np.flatnonzero(_reached(follows, from_command) & _reached(follows.T, to_command))
        phases = [Phase(A[np.ix_(kept, kept)], B[kept], C[:, kept]) for A, B, C in phases]
        self.phases, first = _lumped(phases, np.column_stack([smooth, direct])[kept])
        self.period = period
        self._smooth = smooth[kept[first]]
        self._direct = direct[kept[first]]
        self._held = self._response()
        self._open = functools.reduce(lambda before, matrix: matrix @ before, (A for A, _, _ in self.phases))
        self._fixed = np.linalg.eigvals(self._open)

    def growth(self, *, delay: float = 0.0, lag: float = 0.0) -> float:
        """Rate at which the closed loop's largest deviation grows (1/s), negative where it decays, with a further dead
        time, or lag of every rotor, between command and plant (s). A mode that the cut loop has too, such as a
        covariance's, is none of the loop."""
        new, old, keeps, whole = self._weights(delay, lag)
        size, n = self.phases[0].B.shape
        held = n * (whole + old.any())
        closed = np.eye(size + held)
        for (A, _, C), response in zip(self.phases, self._held, strict=True):
            # Of z and what is held: sent, the newest first, or the lagging one.
            sent = np.vstack([np.hstack([C, np.zeros((n, held))]), np.eye(held, size + held, size)])
            moved = np.hstack([A, np.zeros((size, held))])
            for first, weights in ((whole, new), (whole + 1, old)):
                if weights.any():
                    moved += np.einsum("i,imn->mn", weights, response) @ sent[n * first : n * (first + 1)]
            kept = sent[:held] + keeps * (sent[n : n + held] - sent[:held]) if held else sent[:0]
            closed = np.vstack([moved, kept]) @ closed
        modes = np.linalg.eigvals(closed)
        of_the_loop = np.abs(modes[:, None] - self._fixed).min(axis=1, initial=math.inf) > FIXED
        return math.log(max(np.abs(modes[of_the_loop]).max(initial=0.0), 1e-300)) / (self.period * len(self.phases))

    def gain(self, frequencies: np.ndarray) -> np.ndarray:
        """Complex gains (k, n, n) from v back to u at frequencies (k,) (rad/s) below pi / period. Of u it is the part
        that has this frequency; others, which parts at several rates make of it, pass the plant as little as those of a
        held command do."""
        turn = np.exp(1j * np.reshape(frequencies, (-1, 1, 1)) * self.period)
        count = len(self.phases)
        z: Any = np.zeros_like(self.phases[0].B)
        for j, (A, B, _) in enumerate(self.phases):
            z = A @ z + B * turn**j
        z = np.linalg.solve(turn**count * np.eye(len(self._open)) - self._open, z)
        total: Any = 0.0
        for j, (A, B, C) in enumerate(self.phases):
            total = total + C @ z * turn**-j
            z = A @ z + B * turn**j
        return total / count

    def _weights(self, delay: float, lag: float) -> tuple[np.ndarray, np.ndarray, float, int]:
        """Of the coefficients of `_response`, for the newer of two commands that act in a period, and the older: with
        the fraction f of a delay beyond whole periods the newer acts for 1 - f; with a lag tau the thrust goes over
        from the older to it as 1 - e^{-t / tau}. Then what is kept of the older, and how many periods are whole."""
        if not lag:
            whole = math.floor(delay / self.period + 1e-9)
            new = (1 - max(delay / self.period - whole, 0.0)) ** np.arange(ORDER + 1.0)
            return new, 1 - new, 0.0, whole
        rate = self.period / lag
        old = [math.exp(-rate), -math.expm1(-rate) / rate]  # integral of i (1 - t)^(i - 1) e^{-rate t}, t in periods
        for i in range(1, ORDER):
            old.append((i + 1) * (1 - old[-1]) / rate)
        return 1 - np.array(old), np.array(old), old[0], 0

    def _response(self) -> list[np.ndarray]:
        """Coefficients of t^i, t in periods, of what a command leaves that has acted for t, i = 0 .. ORDER, (.., m, n),
        for each phase: a polynomial through a whole number of periods; what is direct is there from the beginning."""
        inverse = np.linalg.inv(np.vander(np.arange(1.0, ORDER + 1), ORDER + 1, increasing=True)[:, 1:])
        responses = []
        for A, B, _ in self.phases:
            A = A * self._smooth
            b = B * self._smooth[:, None]
            values = [b]
            for _ in range(ORDER - 1):
                values.append((A @ values[-1] + b) * self._smooth[:, None])
            smooth = np.einsum("ij,jmn->imn", inverse, np.array(values))
            responses.append(np.concatenate([(B * self._direct[:, None])[None], smooth]))
        return responses


def _lumped(phases: list[Phase], kinds: np.ndarray) -> tuple[list[Phase], np.ndarray]:
    """The loop with one number in place of those that are always equal, as copies of commands are, and where these were
    first (exact lumping: a partition is refined until numbers of a class follow alike, which random sums over classes
    tell). kinds: only numbers of one kind are put together, (m, k)."""
    m, n = phases[0].B.shape
    rng = np.random.default_rng(0)
    count = 0
    of_class: Any = rng.normal(size=m)
    of_kind = rng.normal(size=kinds.shape[1])
    of_number: Any = rng.normal(size=(len(phases), m))
    of_command = rng.normal(size=(len(phases), n))
    classes = np.zeros(m, int)
    first = np.arange(min(m, 1))
    while len(first) > count:
        count = len(first)
        signature = kinds @ of_kind + of_class[classes]
        for (A, B, _), number, command in zip(phases, of_number, of_command, strict=True):
            signature = signature + A @ number[classes] + B @ command
        _, first, classes = np.unique(np.round(signature, DIGITS), return_index=True, return_inverse=True)
    together = np.eye(len(first))[classes]
    return [Phase(A[first] @ together, B[first], C @ together) for A, B, C in phases], first


def _reached(follows: np.ndarray, begin: np.ndarray) -> np.ndarray:
    """Which places (m,) some of them lead to, by the steps (m, m), to row from column."""
    reached = begin
    while (more := reached | (follows @ reached > 0)).sum() > reached.sum():
        reached = more
    return reached
