"""Minimum of a quadratic function within bounds by a dual active-set method, in numpy, step by step as active_set.c.

    min  1/2 (u - u0)' H (u - u0)      low <= u <= high,     H > 0

Let F be the free inputs, W the working set (inputs held at a bound) and M = H^-1. The tableau S is M after the
symmetric sweep operator on every index of W:

    S_FF = M_FF - M_FW M_WW^-1 M_WF = H_FF^-1,     S_FW = M_FW M_WW^-1,     S_WW = -M_WW^-1

The vector z contains u of the free inputs and the multipliers of the held ones, which solve H (u - u0) + multipliers =
0. Moving one input between F and W is a rank-1 update of S and z. The method is dual (Goldfarb and Idnani 1983): the
signs of the multipliers stay correct, the free input whose violation gives the steepest ascent of the dual cost enters
W next, and an input whose multiplier would change its sign on the way leaves W first. The dual cost increases with
every input that enters, so no working set occurs twice and the work is bounded. The initial working set is that of the
last control step, without the inputs whose multipliers have the wrong sign. Rounding errors are removed by Newton steps
with S on the gradient computed from the problem's data.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

TOLERANCE, LOOSE = 1e-10, 1e-7  # N: bound violation that starts an exchange; error with which a result is accepted
ROUNDS, MOST = 4, 10  # at most: Newton steps; exchanges per input

Inputs = np.ndarray | slice  # which ones
Gradient = Callable[[np.ndarray], np.ndarray]


class Bounded(NamedTuple):
    """u: (m,), within its bounds. side: -1 at the lower, 1 at the upper bound, 0 free. error: estimated error of u."""

    u: np.ndarray
    side: np.ndarray
    exchanges: int
    error: float

    @property
    def solved(self) -> bool:
        """Whether the optimality conditions hold."""
        return bool(self.error <= LOOSE)


def bounded_minimum(
    inverse: np.ndarray, start: np.ndarray, low: np.ndarray, high: np.ndarray, guess: np.ndarray, gradient: Gradient
) -> Bounded:
    """The minimum within bounds.

    inverse: H^-1, (m, m). start: u0, (m,), the minimum without bounds. guess: expected sides, (m,).
    gradient: u -> H (u - u0), computed from the problem's data and not from S, to measure rounding errors.
    """
    tableau = _Tableau(inverse, start, low, high)
    sides = np.where(tableau.fixed, 1.0, guess)
    tableau.hold(np.flatnonzero(sides), sides[sides != 0])
    u, error = start, np.inf
    for _ in range(ROUNDS):
        if not tableau.sound:
            break
        tableau.release_wrong()
        tableau.hold_leaving()
        u = np.clip(np.where(tableau.side == 0, tableau.z, tableau.bound(tableau.side)), low, high)
        error = tableau.refine(u, gradient(u))
        if error <= 10 * TOLERANCE:
            break
    return Bounded(u, tableau.side, tableau.exchanges, error if tableau.sound else np.inf)


class _Tableau:
    """S (m, m), z (m,) and the sides (m,). fixed: inputs whose bounds are equal; they stay in the working set."""

    def __init__(self, inverse: np.ndarray, start: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
        self.S, self.z, self.side = inverse.copy(), start.copy(), np.zeros(start.size)
        self.low, self.high, self.fixed = low, high, low == high
        self.exchanges = 0
        self.sound = bool(np.isfinite(inverse).all() and np.isfinite(start).all() and (np.diag(inverse) > 0).all())

    @property
    def going(self) -> bool:
        return self.sound and self.exchanges < MOST * self.z.size

    def bound(self, side: np.ndarray) -> np.ndarray:
        return np.where(side > 0, self.high, self.low)

    def hold(self, p: Inputs, sides: np.ndarray | float) -> None:
        """Free inputs p enter the working set at a bound; their z become multipliers."""
        self.side[p] = sides
        self.z[p] -= self.bound(self.side)[p]
        self._exchange(p, 1.0)

    def release(self, p: Inputs) -> None:
        """Inputs p leave the working set; their z become values."""
        self._exchange(p, -1.0)
        self.z[p] += self.bound(self.side)[p]
        self.side[p] = 0.0

    def _exchange(self, p: Inputs, turned: float) -> None:
        """Symmetric sweep operator on p, its inverse for turned = -1."""
        columns = self.S[:, p].copy()
        pivots = columns[p]
        self.sound = self.sound and bool(np.all(turned * pivots.diagonal() > 0))
        try:
            inverse = np.linalg.inv(pivots) if pivots.size > 1 else 1.0 / pivots
        except np.linalg.LinAlgError:
            self.sound = False
        if not self.sound:
            return
        shares, moved = columns @ inverse, inverse @ self.z[p]
        self.S -= shares @ columns.T
        self.z -= columns @ moved
        self.z[p] = turned * moved
        shares *= turned
        shares[p] = -inverse
        self.S[:, p], self.S[p] = shares, shares.T
        self.exchanges += moved.size

    def release_wrong(self) -> None:
        """Release inputs whose multipliers have the wrong sign, the steepest descent first."""
        while self.going:
            size = np.abs(np.diag(self.S))
            wrong = (self.side != 0) & ~self.fixed & (self.side * self.z < -TOLERANCE * size)
            if not wrong.any():
                return
            self.release(_only(np.argmax(np.where(wrong, self.z**2 / size, 0.0))))

    def hold_leaving(self) -> None:
        """Hold free inputs that violate their bounds, the steepest ascent of the dual cost first."""
        while self.going:
            excess = np.where(self.side == 0, np.maximum(self.z - self.high, self.low - self.z), 0.0)
            leaving = excess > TOLERANCE
            if not leaving.any():
                return
            size = np.abs(np.diag(self.S))
            i = int(np.argmax(np.where(leaving, excess**2 / size, 0.0)))
            self._raise(i, 1.0 if self.z[i] > self.high[i] else -1.0)

    def _raise(self, i: int, side: float) -> None:
        """Increase the multiplier of input i until it is at its bound; release inputs whose sign changes before."""
        pushed = 0.0
        while self.going:
            column = self.S[i].copy()
            full = (self.z[i] - (self.high[i] if side > 0 else self.low[i])) * side / column[i]
            rate = np.where(self.fixed, 0.0, self.side * side * column)
            falling = rate > 0
            lengths = np.where(falling, np.maximum(self.side * self.z, 0.0) / np.where(falling, rate, 1.0), np.inf)
            blocking = int(np.argmin(lengths))
            if full <= lengths[blocking]:
                self.hold(_only(i), side)
                self.z[i] += pushed
                return
            length = lengths[blocking] * side
            self.z -= column * length
            pushed += length
            self.z[blocking] = 0.0
            self.release(_only(blocking))

    def refine(self, u: np.ndarray, gradient: np.ndarray) -> float:
        """One Newton step from u with its gradient, into z; returns the largest change (N): the error estimate."""
        held = self.side != 0
        step = self.S @ np.where(held, 0.0, gradient)
        self.z = np.where(held, -gradient - step, u - step)
        wrong = np.where(self.fixed, 0.0, -self.side * self.z / np.abs(np.diag(self.S)))
        left = np.where(held, wrong, np.abs(step))
        self.sound = self.sound and bool(np.isfinite(gradient).all() and np.isfinite(left).all())
        return float(max(left.max(), 0.0))


def _only(i: int | np.integer) -> slice:
    return slice(int(i), int(i) + 1)
