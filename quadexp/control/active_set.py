"""Bounded linear-quadratic subproblem: primal-dual active set on the Riccati recursion, with a last resort.

Guess which inputs lie at a bound; solve with those held (one masked Riccati sweep); then hold every input that left its
bounds and release every held one whose multiplier has the wrong sign; repeat until nothing changes (Hintermueller, Ito
and Kunisch 2003). The end satisfies all optimality conditions, so the input is never a clipped one. The set of the last
control step is the first guess. The method can cycle: after a fixed number of sweeps the problem is condensed to the
inputs alone and handed to DAQP, a dual active-set solver that ends in finitely many steps.
"""

from __future__ import annotations

from enum import IntEnum

import casadi as ca
import numpy as np

from quadexp.backend import BufferedFunction

TOLERANCE = 1e-9  # N, and gradient units
LAST_RESORT_TOLERANCE = 1e-6  # N, of a projected gradient step at DAQP's answer


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
        self._daqp: BufferedFunction | None = None
        self.side = np.zeros(self._held.shape, int)  # -1 at the lower, +1 at the upper bound, 0 free
        self.sweeps = 0

    def reset(self) -> None:
        """Forget the active set of the last step."""
        self.side.fill(0)

    def solve(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray, Status]:
        """dX (N, 13), dU (N, n) under low <= dU <= high (N), and how it was found. The arrays are overwritten later."""
        d_state, d_input, gradient = (self._solve.results[name] for name in ("dX", "dU", "gradient"))
        side = self.side
        for sweep in range(1, self._max_sweeps + 1):
            self._held[...] = side != 0
            self._value[...] = np.where(side > 0, high, np.where(side < 0, low, 0.0))
            self._solve()
            if not np.isfinite(d_input).all():
                return d_state, d_input, Status.FAILED
            leaving = (d_input > high + TOLERANCE).astype(int) - (d_input < low - TOLERANCE)
            staying = np.where(side > 0, gradient < TOLERANCE, gradient > -TOLERANCE)
            after = np.where(side == 0, leaving, side * staying)
            if np.array_equal(after, side):
                self.sweeps = sweep
                return d_state, d_input, Status.ACTIVE_SET
            side = self.side = after
        self.sweeps = self._max_sweeps
        status = self._last_resort(low, high)
        return d_state, d_input, status

    def _last_resort(self, low: np.ndarray, high: np.ndarray) -> Status:
        """Condense to the inputs, solve with DAQP, check the optimality conditions; write dX, dU and the active set."""
        arguments, results = self._solve.arguments, self._solve.results
        hessian, gradient, maps, offsets = condense(
            *(self._dense_blocks(name) for name in ("A", "B")),
            *(arguments[name] for name in ("b", "q", "r", "Q", "Q_end", "R")),
        )
        if not np.isfinite(hessian).all():
            return Status.FAILED
        solver = self._daqp = self._daqp or BufferedFunction(_dense_solver(low.size))
        solver.arguments["h"][...], solver.arguments["g"][...] = hessian, gradient
        solver.arguments["lbx"][...], solver.arguments["ubx"][...] = low.reshape(-1), high.reshape(-1)
        try:
            solver()
        except RuntimeError:
            return Status.FAILED
        d_input = solver.results["x"]
        # DAQP's own word is not enough: the projected gradient step must leave its answer where it is.
        step = (hessian @ d_input + gradient) / np.diag(hessian)
        moved = np.clip(d_input - step, low.reshape(-1), high.reshape(-1)) - d_input
        if not np.abs(moved).max() < LAST_RESORT_TOLERANCE:
            return Status.FAILED
        results["dU"][...] = np.clip(d_input.reshape(low.shape), low, high)  # rounding only
        results["dX"][...] = maps @ d_input + offsets
        self.side = (results["dU"] >= high - TOLERANCE).astype(int) - (results["dU"] <= low + TOLERANCE)
        return Status.LAST_RESORT

    def _dense_blocks(self, name: str) -> np.ndarray:
        """(N, 13, columns) from the horizontally stacked, perhaps sparse, argument `name`."""
        function = self._solve.function
        sparsity = function.sparsity_in(function.index_in(name))
        stacked = ca.DM(sparsity, self._solve.arguments[name].reshape(-1)).full()
        return np.stack(np.split(stacked, len(self.side), axis=1))


def _dense_solver(size: int) -> ca.Function:
    """DAQP on a dense problem with simple bounds."""
    shape = {"h": ca.Sparsity.dense(size, size), "a": ca.Sparsity(0, size)}
    return ca.conic("last_resort", "daqp", shape, {"error_on_fail": False, "print_time": False})


def condense(
    A: np.ndarray,
    B: np.ndarray,
    b: np.ndarray,
    q: np.ndarray,
    r: np.ndarray,
    Q: np.ndarray,
    Q_end: np.ndarray,
    R: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
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
    flat = maps.reshape(nodes * states, nodes * n)
    hessian = flat.T @ (weight.reshape(-1, 1) * flat) + np.diag(np.tile(R, nodes))
    gradient = flat.T @ (weight * offsets + q[1:]).reshape(-1) + r.reshape(-1)
    return hessian, gradient, maps, offsets
