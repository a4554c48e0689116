"""Bounded linear-quadratic subproblem: primal-dual active set on the Riccati recursion, with a last resort.

Guess which inputs lie at a bound; solve with those held (one masked Riccati sweep); then hold every input that left its
bounds and release every held one whose multiplier has the wrong sign; repeat until nothing changes (Hintermueller, Ito
and Kunisch 2003). The end satisfies all optimality conditions, so the input is never a clipped one. The set of the last
control step is the first guess. The method can cycle: when a set comes back, or after a fixed number of sweeps, the
problem is condensed to the inputs alone and handed to DAQP, a dual active-set solver that ends in finitely many steps.
"""

from __future__ import annotations

import math
from enum import IntEnum

import casadi as ca
import numpy as np

from quadexp.backend import BufferedFunction
from quadexp.control.subproblem import TOLERANCE

LAST_RESORT_TOLERANCE = 1e-6  # N, of a projected gradient step at DAQP's answer


class Status(IntEnum):
    """How a subproblem was solved."""

    RICCATI = 0  # no bound active
    ACTIVE_SET = 1
    LAST_RESORT = 2
    FAILED = 3


class ActiveSet:
    """Solver of the bounded subproblem that a control step leaves behind.

    sweep, condensed: `control.subproblem`'s functions on a back end.
    data: what both need of a step and its settings, by name: A, B, b, q, r, Q, Q_end, R, and frames where the step has
    them; arrays that are read at every `solve`.
    """

    def __init__(
        self, sweep: ca.Function, condensed: ca.Function, data: dict[str, np.ndarray], *, max_sweeps: int
    ) -> None:
        self._sweep, self._condensed = BufferedFunction(sweep, data), BufferedFunction(condensed, data)
        self._max_sweeps = max_sweeps
        self._low, self._high = (self._sweep.arguments[name] for name in ("low", "high"))
        self._daqp: BufferedFunction | None = None
        self.side = self._sweep.arguments["side"]  # (N, n): -1 at the lower, 1 at the upper bound, 0 free
        self.sweeps = 0

    def reset(self) -> None:
        """Forget the active set of the last step."""
        self.side.fill(0)

    def solve(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray, Status]:
        """dX (N, 13), dU (N, n) under low <= dU <= high (N), and how it was found. The arrays are overwritten later."""
        d_state, d_input, after, checks = (self._sweep.results[name] for name in ("dX", "dU", "after", "checks"))
        self._low[...], self._high[...] = low, high
        seen = set()
        self.sweeps = 0
        while self.sweeps < self._max_sweeps:
            self._sweep()
            self.sweeps += 1
            misplaced, size = checks.tolist()
            if not math.isfinite(size):
                return d_state, d_input, self._failed()
            if misplaced == 0:
                return d_state, d_input, Status.ACTIVE_SET
            seen.add(self.side.astype(np.int8).tobytes())
            self.side[...] = after
            if self.side.astype(np.int8).tobytes() in seen:
                break
        return d_state, d_input, self._last_resort(low, high)

    def _last_resort(self, low: np.ndarray, high: np.ndarray) -> Status:
        """Condense to the inputs, solve with DAQP, check the optimality conditions; leave dX, dU and the active set."""
        self._condensed()
        hessian, gradient = self._condensed.results["H"], self._condensed.results["g"]
        if not np.isfinite(hessian).all():
            return self._failed()
        solver = self._daqp = self._daqp or BufferedFunction(_dense_solver(low.size))
        solver.arguments["h"][...], solver.arguments["g"][...] = hessian, gradient
        solver.arguments["lbx"][...], solver.arguments["ubx"][...] = low.ravel(), high.ravel()
        try:
            solver()
        except RuntimeError:
            return self._failed()
        d_input = np.clip(solver.results["x"].reshape(low.shape), low, high)  # rounding only
        self._low[...] = self._high[...] = d_input
        self.side.fill(1)
        self._sweep()  # with every input held where DAQP wants it: the states that follow, and the gradient there
        # DAQP's own word is not enough: the projected gradient step must leave its answer where it is.
        step = self._sweep.results["gradient"] / np.diag(hessian).reshape(low.shape)
        moved = np.clip(d_input - step, low, high) - d_input
        if not np.abs(moved).max() < LAST_RESORT_TOLERANCE:
            return self._failed()
        self.side[...] = (d_input >= high - TOLERANCE).astype(int) - (d_input <= low + TOLERANCE)
        return Status.LAST_RESORT

    def _failed(self) -> Status:
        self.reset()
        return Status.FAILED


def _dense_solver(size: int) -> ca.Function:
    """DAQP on a dense problem with simple bounds."""
    shape = {"h": ca.Sparsity.dense(size, size), "a": ca.Sparsity(0, size)}
    return ca.conic("last_resort", "daqp", shape, {"error_on_fail": False, "print_time": False})
