"""Bounded linear-quadratic subproblem: primal-dual active set on the Riccati recursion, with a last resort.

Guess which inputs lie at a bound; solve with those held (one masked Riccati sweep); then hold every input that left its
bounds and release every held one whose multiplier has the wrong sign; repeat until nothing changes (Hintermueller, Ito
and Kunisch 2003). The end satisfies all optimality conditions, so the input is never a clipped one. The set of the last
control step is the first guess. Exchanging all offenders at once can cycle; where their number has not fallen for
PATIENCE sweeps only the last one is exchanged, which cannot (block principal pivoting, Judice and Pires 1994). Should the
sweeps run out all the same, the problem is condensed to the inputs alone and handed to DAQP, a dual active-set solver.
"""

from __future__ import annotations

from enum import IntEnum

import casadi as ca
import numpy as np

from quadexp.backend import BufferedFunction

TOLERANCE = 1e-9  # N, and gradient units
PATIENCE = 3  # sweeps without fewer offenders before they are exchanged one at a time


class Status(IntEnum):
    """How a subproblem was solved."""

    RICCATI = 0  # no bound active
    ACTIVE_SET = 1
    LAST_RESORT = 2
    FAILED = 3


class ActiveSet:
    """Solver of the bounded subproblem that the control step leaves behind.

    bounded: buffered `control.step.bounded_function`; the caller fills its arguments A, B, b, q, r, Q, Q_end and R with
    what the step left behind, before `solve`.
    """

    def __init__(self, bounded: BufferedFunction, *, max_sweeps: int) -> None:
        self._solve = bounded
        self._max_sweeps = max_sweeps
        self._held, self._value = bounded.arguments["held"], bounded.arguments["value"]
        self._condensed: ca.Function | None = None
        self.side = np.zeros(self._held.shape, int)  # -1 at the lower, +1 at the upper bound, 0 free
        self.sweeps = 0

    def reset(self) -> None:
        """Forget the active set of the last step."""
        self.side[:] = 0

    def solve(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray, Status]:
        """dX (N, 13), dU (N, n) under low <= dU <= high (N), and how it was found. The arrays are overwritten later."""
        d_state, d_input, gradient = (self._solve.results[name] for name in ("dX", "dU", "gradient"))
        side, fewest, patience = self.side, self.side.size + 1, PATIENCE
        for sweep in range(1, self._max_sweeps + 1):
            self._held[...] = side != 0
            self._value[...] = np.where(side > 0, high, np.where(side < 0, low, 0.0))
            self._solve()
            if not np.isfinite(d_input).all():
                return d_state, d_input, Status.FAILED
            leaving = (d_input > high + TOLERANCE).astype(int) - (d_input < low - TOLERANCE)
            staying = np.where(side > 0, gradient < TOLERANCE, gradient > -TOLERANCE)
            after = np.where(side == 0, leaving, side * staying)
            offenders = np.flatnonzero(after != side)
            if len(offenders) == 0:
                self.sweeps = sweep
                return d_state, d_input, Status.ACTIVE_SET
            if len(offenders) < fewest:
                fewest, patience = len(offenders), PATIENCE
            elif patience > 0:
                patience -= 1
            else:
                keep = offenders[:-1]
                after.flat[keep] = side.flat[keep]
            side = self.side = after
        self.sweeps = self._max_sweeps
        status = self._last_resort(low, high)
        return d_state, d_input, status

    def _last_resort(self, low: np.ndarray, high: np.ndarray) -> Status:
        """Condense to the inputs and solve with DAQP; write dX, dU and the active set."""
        arguments, results = self._solve.arguments, self._solve.results
        nodes, n = low.shape
        if self._condensed is None:
            shape = {"h": ca.Sparsity.dense(nodes * n, nodes * n), "a": ca.Sparsity.dense(0, nodes * n)}
            self._condensed = ca.conic("last_resort", "daqp", shape, {"error_on_fail": False, "print_time": False})
        hessian, gradient, maps, offsets = condense(
            *(self._dense_blocks(name) for name in ("A", "B")),
            *(arguments[name] for name in ("b", "q", "r", "Q", "Q_end", "R")),
        )
        solution = self._condensed(h=hessian, g=gradient, lbx=low.reshape(-1), ubx=high.reshape(-1))
        d_input = np.array(solution["x"]).reshape(-1)
        if not self._condensed.stats()["success"] or not np.isfinite(d_input).all():
            self.reset()
            return Status.FAILED
        results["dU"][...] = np.clip(d_input.reshape(nodes, n), low, high)  # rounding of the solver only
        results["dX"][...] = (maps @ d_input) + offsets
        self.side = (results["dU"] >= high - TOLERANCE).astype(int) - (results["dU"] <= low + TOLERANCE)
        return Status.LAST_RESORT

    def _dense_blocks(self, name: str) -> np.ndarray:
        """(N, 13, columns) from the horizontally stacked, perhaps sparse, argument `name`."""
        function = self._solve.function
        sparsity = function.sparsity_in(function.index_in(name))
        stacked = ca.DM(sparsity, self._solve.arguments[name].reshape(-1)).full()
        return np.stack(np.split(stacked, len(self.side), axis=1))


def condense(A, B, b, q, r, Q, Q_end, R):
    """Eliminate the states: min 1/2 d'H d + g'd over d = (du_0 .. du_{N-1}).

    A (N, 13, 13), B (N, 13, n), b (N, 13), q (N + 1, 13), r (N, n); Q, Q_end (13,), R (n,) diagonals.
    Returns H (Nn, Nn), g (Nn,), and the states as dx_{k+1} = maps[k] d + offsets[k], (N, 13, Nn) and (N, 13).
    """
    nodes, states, n = B.shape
    maps, offsets = np.zeros((nodes, states, nodes * n)), np.zeros((nodes, states))
    row, offset = np.zeros((states, nodes * n)), np.zeros(states)
    for k in range(nodes):
        row, offset = A[k] @ row, A[k] @ offset + b[k]
        row[:, k * n : (k + 1) * n] += B[k]
        maps[k], offsets[k] = row, offset
    weight = np.vstack([np.tile(Q, (nodes - 1, 1)), Q_end])
    hessian = np.einsum("kij,ki,kil->jl", maps, weight, maps) + np.diag(np.tile(R, nodes))
    gradient = np.einsum("kij,ki->j", maps, weight * offsets + q[1:]) + r.reshape(-1)
    return hessian, gradient, maps, offsets
