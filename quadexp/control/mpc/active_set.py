"""Exact solution of the bounded linear-quadratic subproblem, from the Riccati factorisation of the control step.

The step has solved the subproblem without bounds. With the states eliminated it is a problem in the inputs alone; its
inverse Hessian M = H^-1, (n N, n N), follows from the Riccati gains in one backward pass. A unit gradient in input i of
node j propagates backwards to h_k in the nodes k <= j (later ones are zero), and M is a sum over the nodes:

    h_k = e_i [k = j] + B_k' p_{k+1},     p_k = A_k' p_{k+1} - K_k' h_k,     M_(i,l) = sum_k h_k(i)' H_k^-1 h_k(l)

A dual active-set method (control.mpc.dual_active_set) then finds the inputs at a bound, starting with the active set of
the last control step. The optimality conditions of the result are checked in the subproblem itself; where they do not
hold to 1e-7 N the step has status FAILED. An input is never just clipped.

The compiled form is one function (active_set.c); this file is the same method in numpy, for the interpreted back end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntEnum
from typing import Protocol

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.mpc.dual_active_set import bounded_minimum
from quadexp.physics.state import ATTITUDE


class Status(IntEnum):
    """How a subproblem was solved."""

    RICCATI = 0  # no bound active
    ACTIVE_SET = 1
    LAST_RESORT = 2  # only in flights recorded by earlier versions
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


def make_active_set(bounded: ca.Function | None, step: BufferedFunction) -> ActiveSet:
    """The solver on the arrays of `step`. bounded: the compiled function, or None for numpy."""
    shared = step.arguments | step.results | {"U_free": step.results["U_new"]}
    return ActiveSet(InterpretedSolver(step.function, shared) if bounded is None else BufferedFunction(bounded, shared))


class InterpretedSolver:
    """`subproblem.bounded_function` in numpy, with the same arguments and results.

    step: the control step; data: its arguments and results by name, read at every call.
    """

    def __init__(self, step: ca.Function, data: Mapping[str, np.ndarray]) -> None:
        self._data = data
        self._places = {name: _places(step.sparsity_out(step.index_out(name))) for name in ("A", "B")}
        nodes, n = data["U_lin"].shape
        self._states = states = data["Q"].shape[1]
        self.arguments = {"guess": np.zeros((nodes, n))}
        self.results = {"X_new": np.zeros((nodes + 1, states)), "U_new": np.zeros((nodes, n))}
        self.results |= {"side": np.zeros((nodes, n)), "checks": np.zeros(5)}

    def __call__(self) -> None:
        """Solve; data that are not finite give `solved` = 0."""
        with np.errstate(all="ignore"):
            self._solve()

    def _solve(self) -> None:
        data, (nodes, n) = self._data, self.arguments["guess"].shape
        A, B = (self._transposed(name) for name in ("A", "B"))
        U, weights = data["U_lin"], np.vstack([data["Q"][1:], data["Q_end"]])

        d_state = np.zeros((nodes, self._states))

        def gradient(flat: np.ndarray) -> np.ndarray:
            """Gradient of the cost in the changes of all inputs; the states that follow are left in d_state."""
            d_input, d = flat.reshape(nodes, n), np.zeros(self._states)
            pushed = np.einsum("ki,kij->kj", d_input, B) + data["b"]
            for k in range(nodes):
                d_state[k] = d = d @ A[k] + pushed[k]
            slopes = data["q"][1:] + weights * d_state
            result, p = data["r"] + data["R"] * d_input, np.zeros(self._states)
            for k in range(nodes - 1, -1, -1):
                p += slopes[k]
                result[k] += B[k] @ p
                p = A[k] @ p
            return result.ravel()

        found = bounded_minimum(
            self._inverse_hessian(A, B),
            (data["U_free"] - U).ravel(),
            (data["u_min"] - U).ravel(),
            (data["u_max"] - U).ravel(),
            self.arguments["guess"].ravel(),
            gradient,
        )
        d_input, results = found.u.reshape(nodes, n), self.results
        turn = np.linalg.norm(d_state[:, ATTITUDE], axis=1).max()
        if "frames" in data:  # from the cost's coordinates, see control.attitude_error: dq = L de
            frames = data["frames"].reshape(nodes + 1, 4, 4)
            d_state[:, ATTITUDE] = np.einsum("kcr,kc->kr", frames[1:], d_state[:, ATTITUDE])
        results["X_new"][...] = data["X_lin"]
        results["X_new"][1:] += d_state
        results["U_new"][...] = np.clip(U + d_input, data["u_min"], data["u_max"])  # rounding only
        results["side"][...] = found.side.reshape(nodes, n)
        results["checks"][...] = found.solved, found.exchanges, np.count_nonzero(found.side), found.error, turn

    def _transposed(self, name: str) -> np.ndarray:
        """A' or B' of every node, dense: (N, m, m) or (N, n, m)."""
        nodes = len(self._data["U_lin"])
        dense = np.zeros((self._places[name][1], self._states))
        dense.ravel()[self._places[name][0]] = self._data[name].ravel()
        return dense.reshape(nodes, -1, self._states)

    def _inverse_hessian(self, A: np.ndarray, B: np.ndarray) -> np.ndarray:
        """M = H^-1, (n N, n N), from A', B' and the step's factorisation."""
        nodes, n = self.arguments["guess"].shape
        K = self._data["K"].reshape(nodes, self._states, n)  # transposed, as it is stored
        factors = self._data["factor"].reshape(nodes, n, n).transpose(0, 2, 1)
        from_L = np.linalg.inv(np.tril(factors, -1) + np.eye(n))
        from_D = np.diagonal(factors, axis1=1, axis2=2)
        at_nodes = from_L.transpose(0, 2, 1) @ (from_D[:, :, None] * from_L)  # H_k^-1
        inverse, p = np.zeros((nodes * n, nodes * n)), np.zeros((self._states, 0))
        for k in range(nodes - 1, -1, -1):
            h = np.hstack([np.eye(n), B[k] @ p])
            inverse[k * n :, k * n :] += h.T @ (at_nodes[k] @ h)
            p = np.hstack([np.zeros((self._states, n)), A[k] @ p]) - K[k] @ h
        return inverse


def _places(pattern: ca.Sparsity) -> tuple[np.ndarray, int]:
    """Positions of the structural non-zeros of a matrix stored by columns, and its number of columns."""
    rows, columns = pattern.get_triplet()
    return np.array(columns) * pattern.size1() + np.array(rows), pattern.size2()
