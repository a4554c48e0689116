"""Bounded quadratic minimum by a dual active set, in numpy: what active_set.c does, step by step.

    min  1/2 (u - u0)' H (u - u0)      low <= u <= high,     H > 0

is solved on its tableau. With the inputs F free, W held at a bound and M = H^-1, let S be M after the symmetric sweep
operator on every index of W:

    S_FF = M_FF - M_FW M_WW^-1 M_WF = H_FF^-1,     S_FW = M_FW M_WW^-1,     S_WW = -M_WW^-1

z holds u of a free input and the multiplier of a held one: all that H (u - u0) + multipliers = 0 says. Exchanging one
input between F and W is one rank-1 update of S and z. The method is dual (Goldfarb and Idnani 1983): multipliers never
have the wrong sign, the free input that leaves its bounds by the steepest ascent is held next, and on the way there
what would get a multiplier of the wrong sign is released. The dual cost rises with every input that is held, so no set
comes back, and the work is bounded. It starts from a guess, the set of the last control step, after releasing what has
a wrong sign there. What rounding leaves is seen in the true gradient and taken back by Newton steps with S.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

TOLERANCE, LOOSE = 1e-10, 1e-7  # N, of an input: left by the exchanges; left by rounding where no more can be had
ROUNDS, MOST = 4, 10  # Newton steps; exchanges, per input

Inputs = np.ndarray | slice  # which ones
Gradient = Callable[[np.ndarray], np.ndarray]


class Bounded(NamedTuple):
    """u: (m,), within its bounds. side: -1 held at the lower, 1 at the upper bound, 0 free. error: left in u."""

    u: np.ndarray
    side: np.ndarray
    exchanges: int
    error: float

    @property
    def solved(self) -> bool:
        """Whether all conditions of the minimum hold."""
        return bool(self.error <= LOOSE)


def bounded_minimum(
    inverse: np.ndarray, start: np.ndarray, low: np.ndarray, high: np.ndarray, guess: np.ndarray, gradient: Gradient
) -> Bounded:
    """The minimum within bounds.

    inverse: H^-1, (m, m). start: u0, (m,), the minimum without bounds. guess: sides expected, (m,).
    gradient: u -> H (u - u0), computed without S, to see what rounding does.
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
    """S, z and the sides, (m, m), (m,), (m,). fixed: inputs with one value only; they stay held."""

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
        """Free inputs p go to their bounds; z of them becomes their multipliers."""
        self.side[p] = sides
        self.z[p] -= self.bound(self.side)[p]
        self._exchange(p, 1.0)

    def release(self, p: Inputs) -> None:
        """The multipliers of held inputs p go to zero; z of them becomes their values."""
        self._exchange(p, -1.0)
        self.z[p] += self.bound(self.side)[p]
        self.side[p] = 0.0

    def _exchange(self, p: Inputs, turned: float) -> None:
        """The symmetric sweep operator on p, backwards where turned = -1."""
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
        """Release held inputs whose multipliers have the wrong sign, the steepest first."""
        while self.going:
            size = np.abs(np.diag(self.S))
            wrong = (self.side != 0) & ~self.fixed & (self.side * self.z < -TOLERANCE * size)
            if not wrong.any():
                return
            self.release(_only(np.argmax(np.where(wrong, self.z**2 / size, 0.0))))

    def hold_leaving(self) -> None:
        """Hold free inputs that leave their bounds, the steepest ascent of the dual cost first."""
        while self.going:
            excess = np.where(self.side == 0, np.maximum(self.z - self.high, self.low - self.z), 0.0)
            leaving = excess > TOLERANCE
            if not leaving.any():
                return
            size = np.abs(np.diag(self.S))
            i = int(np.argmax(np.where(leaving, excess**2 / size, 0.0)))
            self._raise(i, 1.0 if self.z[i] > self.high[i] else -1.0)

    def _raise(self, i: int, side: float) -> None:
        """Raise the multiplier of input i until it is at its bound; release what would get a wrong sign before."""
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
        """One Newton step from u with its true gradient, into z; the largest change (N) that it says is left."""
        held = self.side != 0
        step = self.S @ np.where(held, 0.0, gradient)
        self.z = np.where(held, -gradient - step, u - step)
        wrong = np.where(self.fixed, 0.0, -self.side * self.z / np.abs(np.diag(self.S)))
        left = np.where(held, wrong, np.abs(step))
        self.sound = self.sound and bool(np.isfinite(gradient).all() and np.isfinite(left).all())
        return float(max(left.max(), 0.0))


def _only(i: int | np.integer) -> slice:
    return slice(int(i), int(i) + 1)
