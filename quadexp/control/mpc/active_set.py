"""Exact solution of the bounded linear-quadratic subproblem, from the Riccati factorisation of the control step.

The step has solved the subproblem without bounds. With the states eliminated it is a problem in the inputs alone; its
inverse Hessian M = H^-1, (n N, n N), follows from the Riccati gains in one backward pass. A unit gradient in input i of
node j propagates backwards to h_k in the nodes k <= j (later ones are zero), and M is a sum over the nodes:

    h_k = e_i [k = j] + B_k' p_{k+1},     p_k = A_k' p_{k+1} - K_k' h_k,     M_(i,l) = sum_k h_k(i)' H_k^-1 h_k(l)

A dual active-set method then finds the inputs at a bound, starting with the active set of the last control step. The
optimality conditions of the result are checked in the subproblem itself; where they do not hold to 1e-7 N the step has
status FAILED. An input is never just clipped.

That is the compiled form, one function (active_set.c). The interpreted one makes H from the dynamics and has CasADi's
`conic` find the inputs at a bound (DAQP: Arnstroem, Bemporad, Axehill 2022); with these the others follow exactly.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from enum import IntEnum
from functools import cache
from typing import Any, Protocol

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.physics.state import ATTITUDE, norms

TOLERANCE, LOOSE = 1e-10, 1e-7  # N: violation that changes the active set; error with which a result is accepted
ROUNDS = 10  # of the active set, at most, after DAQP's


class Status(IntEnum):
    """How a subproblem was solved."""

    RICCATI = 0  # no bound active
    ACTIVE_SET = 1
    FAILED = 3


class Solver(Protocol):
    """subproblem.bounded_function on a back end."""

    arguments: dict[str, np.ndarray]
    results: dict[str, np.ndarray]

    def __call__(self) -> None:
        """Read the arguments, write the results."""


class ActiveSet:
    """Solver of the bounded subproblem, warm-started with the active set of the last control step.

    Results of `solve`, overwritten by the next call: X_new (N + 1, m), U_new (N, n); side (N, n), -1 at the lower, 1 at
    the upper bound, 0 free; exchanges: changes of the active set; active: number of inputs at a bound; turn: the
    largest change of a quaternion (length).
    """

    def __init__(self, solver: Solver) -> None:
        self.solver = solver
        self.side = solver.arguments["guess"]
        self.X_new, self.U_new, self._side, self._checks = (
            solver.results[name] for name in ("X_new", "U_new", "side", "checks")
        )
        self.exchanges = self.active = 0
        self.turn = self.error = 0.0

    def reset(self) -> None:
        """Start with an empty active set."""
        self.side.fill(0)

    def solve(self) -> Status:
        """Solve the subproblem of the last control step."""
        self.solver()
        solved, exchanges, active, self.error, self.turn = self._checks.tolist()
        self.exchanges = int(exchanges)
        if not (solved and math.isfinite(self.error + self.turn)):
            self.reset()
            self.active = 0
            return Status.FAILED
        self.active = int(active)
        self.side[...] = self._side
        return Status.ACTIVE_SET


def make_active_set(step: Any, bounded: ca.Function | None = None) -> ActiveSet:
    """The solver on the arrays of a step.Step. bounded: the compiled function; None: without a compiler."""
    shared = step.arguments | step.results | {"U_free": step.results["U_new"]}
    return ActiveSet(InterpretedSolver(step.sparsity, shared) if bounded is None else BufferedFunction(bounded, shared))


class InterpretedSolver:
    """`subproblem.bounded_function` without a compiler, with the same arguments and results but for `exchanges`, which
    counts what is another than in the guess.

    patterns: sparsities of A and B; data: arguments and results of the step by name, read at every call.
    """

    def __init__(self, patterns: Mapping[str, ca.Sparsity], data: Mapping[str, np.ndarray]) -> None:
        self._data, self._patterns = data, {name: patterns[name] for name in ("A", "B")}
        nodes, n = data["U_lin"].shape
        self._states = states = data["Q"].shape[1]
        self.arguments = {"guess": np.zeros((nodes, n))}
        self.results = {"X_new": np.zeros((nodes + 1, states)), "U_new": np.zeros((nodes, n))}
        self.results |= {"side": np.zeros((nodes, n)), "checks": np.zeros(5)}

    def __call__(self) -> None:
        """Solve; data that are not finite give `solved` = 0."""
        data, results = self._data, self.results
        with np.errstate(all="ignore"):
            maps, offsets = self._condensed()
            weights = np.concatenate([*data["Q"][1:], data["Q_end"]])
            H = np.diag(data["R"].ravel()) + maps.T @ (weights[:, None] * maps)
            g = data["r"].ravel() + maps.T @ (weights * offsets + data["q"][1:].ravel())
            U, guess = data["U_lin"], self.arguments["guess"]
            low, high = (data["u_min"] - U).ravel(), (data["u_max"] - U).ravel()
            used = [data[name] for name in ("K", "factor", "U_free")]  # of the unbounded solution
            d_input, side, error = np.zeros(g.size), np.zeros(g.size), np.inf
            if all(np.isfinite(part).all() for part in (H, g, *used)):
                d_input, side, error = bounded_minimum(H, g, low, high)
            d_state = (offsets + maps @ d_input).reshape(len(U), self._states)
        turn = norms(d_state[:, ATTITUDE]).max()
        if "frames" in data:  # from the cost's coordinates, see control.attitude_error: dq = L de
            frames = data["frames"].reshape(-1, 4, 4)
            d_state[:, ATTITUDE] = np.einsum("kcr,kc->kr", frames[1:], d_state[:, ATTITUDE])
        results["X_new"][...] = data["X_lin"]
        results["X_new"][1:] += d_state
        results["U_new"][...] = np.clip(U + d_input.reshape(U.shape), data["u_min"], data["u_max"])  # rounding only
        results["side"][...] = side.reshape(U.shape)
        exchanges = np.count_nonzero(results["side"] != guess)
        results["checks"][...] = error <= LOOSE, exchanges, np.count_nonzero(side), error, turn

    def _condensed(self) -> tuple[np.ndarray, np.ndarray]:
        """The states' changes as maps (m N, n N) of all inputs' changes, and offsets (m N,)."""
        nodes, n = self._data["U_lin"].shape
        A, B = (
            np.split(ca.DM(pattern, self._data[name].ravel()).full(), nodes, axis=1)
            for name, pattern in self._patterns.items()
        )
        maps, offsets = np.zeros((nodes, self._states, nodes * n)), np.zeros((nodes, self._states))
        for k in range(nodes):
            offsets[k] = self._data["b"][k]
            if k:
                maps[k], offsets[k] = A[k] @ maps[k - 1], offsets[k] + A[k] @ offsets[k - 1]
            maps[k, :, k * n : (k + 1) * n] = B[k]
        return maps.reshape(-1, nodes * n), offsets.ravel()


def bounded_minimum(
    H: np.ndarray, g: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Minimum of 1/2 u'Hu + g'u with low <= u <= high: u (m,); side, -1 at the lower, 1 at the upper bound,
    0 free; and the estimated error of u, infinite where H is singular to rounding."""
    with _one_at_a_time:
        multiplier = np.array(_daqp(g.size)(h=H, g=g, lbx=low, ubx=high)["lam_x"]).ravel()
    side, scale, fixed = np.sign(multiplier), np.diag(H), low == high
    for _ in range(ROUNDS):
        side = np.where(fixed, 1.0, side)
        free = side == 0
        u = np.where(side > 0, high, low)
        try:
            u[free] = np.linalg.solve(H[np.ix_(free, free)], -g[free] - H[np.ix_(free, ~free)] @ u[~free])
        except np.linalg.LinAlgError:
            return np.zeros(g.size), np.zeros(g.size), np.inf
        wrong = np.where(free | fixed, 0.0, side * (H @ u + g) / scale)  # multipliers of the other sign
        excess = np.where(free, np.maximum(u - high, low - u), 0.0)
        if max(wrong.max(), excess.max()) <= TOLERANCE:
            break
        side = np.where(wrong > TOLERANCE, 0.0, side)
        side = np.where(excess > TOLERANCE, np.where(u > high, 1.0, -1.0), side)
    return np.clip(u, low, high), np.where(fixed, 1.0, side), float(max(wrong.max(), excess.max(), 0.0))


_one_at_a_time = threading.Lock()  # two threads in DAQP end the process


@cache
def _daqp(size: int) -> ca.Function:
    return ca.conic("daqp", "daqp", {"h": ca.Sparsity.dense(size, size)}, {"error_on_fail": False})
