"""Exact solution of the bounded linear-quadratic subproblem, from the Riccati factorisation of the control step.

The step has solved the subproblem without bounds. With the states eliminated it is a problem in the inputs alone; its
inverse Hessian M = H^-1, (n N, n N), follows from the Riccati gains in one backward pass. A unit gradient in input i of
node j propagates backwards to h_k in the nodes k <= j (later ones are zero), and M is a sum over the nodes:

    h_k = e_i [k = j] + B_k' p_{k+1},     p_k = A_k' p_{k+1} - K_k' h_k,     M_(i,l) = sum_k h_k(i)' H_k^-1 h_k(l)

A dual active-set method then finds the inputs at a bound, starting with the active set of the last control step. The
optimality conditions of the result are checked in the subproblem itself; where they do not hold to 1e-7 N the step has
status FAILED. An input is never just clipped.

That is the compiled form (active_set.c). The interpreted one makes H from the dynamics and has CasADi's
`conic` find the inputs at a bound (DAQP: Arnstroem, Bemporad, Axehill 2022); with these the others follow exactly.
"""

from __future__ import annotations

import math
import threading
from enum import IntEnum
from functools import cache

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.mpc.node import Form
from quadexp.control.mpc.step import Arrays, Step, dynamics_of
from quadexp.physics.state import ATTITUDE, norms

TOLERANCE = 1e-10  # N, violation that changes the active set
LOOSE = 1e-7  # N, error with which a result is accepted
ROUNDS = 10  # of the active set, at most, after DAQP's


class Status(IntEnum):
    """How a subproblem was solved."""

    OK = 0  # no bound active
    RICCATI = 0  # its name for one release more, in controllers of users
    ACTIVE_SET = 1
    FAILED = 3


class ActiveSet:
    """Solver of the bounded subproblem, warm-started with the active set of the last control step.

    Results of `solve`, overwritten by the next call: X_new (N + 1, m), U_new (N, n); side (N, n), -1 at the lower, 1 at
    the upper bound, 0 free; exchanges: changes of the active set; active: number of inputs at a bound; turn: the
    largest change of a quaternion (length).
    """

    def __init__(self, step: Step) -> None:
        self._solve = step.bounded
        self.side = step.arguments["guess"]
        self.X_new, self.U_new, self._side, self._checks = (
            step.results[name] for name in ("bounded_X", "bounded_U", "side", "bounded_checks")
        )
        self.exchanges = self.active = 0
        self.turn = self.error = 0.0

    def reset(self) -> None:
        """Start with an empty active set."""
        self.side.fill(0)

    def solve(self) -> Status:
        """Solve the subproblem of the last control step."""
        self._solve()
        solved, exchanges, active, self.error, self.turn = self._checks.tolist()
        self.exchanges = int(exchanges)
        if not (solved and math.isfinite(self.error + self.turn)):
            self.reset()
            self.active = 0
            return Status.FAILED
        self.active = int(active)
        self.side[...] = self._side
        return Status.ACTIVE_SET


class InterpretedSolver:
    """The bounded subproblem without a compiler. Its exchanges are what is another than in the guess.

    data: arguments and results of the step by name, read and written at every call.
    """

    def __init__(self, form: Form, data: Arrays) -> None:
        self._form = form
        self._data = data

    def __call__(self) -> None:
        """Solve; data that are not finite give `solved` = 0."""
        data = self._data
        with np.errstate(all="ignore"):
            maps, offsets = self._condensed()
            weights = np.concatenate([*data["Q"][1:], data["Q_end"]])
            H = np.diag(data["R"].ravel()) + maps.T @ (weights[:, None] * maps)
            g = data["r"].ravel() + maps.T @ (weights * offsets + data["q"][1:].ravel())
            U = data["U_lin"]
            low = (data["u_min"] - U).ravel()
            high = (data["u_max"] - U).ravel()
            used = [data[name] for name in ("K", "factor", "U_new")]  # of the unbounded solution
            d_input = np.zeros(g.size)
            side = np.zeros(g.size)
            error = np.inf
            if all(np.isfinite(part).all() for part in (H, g, *used)):
                d_input, side, error = bounded_minimum(H, g, low, high)
            d_state = (offsets + maps @ d_input).reshape(len(U), -1)
        turn = norms(d_state[:, ATTITUDE]).max()
        if self._form.frames:  # from the cost's coordinates, see control.attitude_error: dq = L de
            d_state[:, ATTITUDE] = np.einsum("kcr,kc->kr", data["frames"][1:], d_state[:, ATTITUDE])
        data["bounded_X"][...] = data["X_lin"]
        data["bounded_X"][1:] += d_state
        data["bounded_U"][...] = np.clip(U + d_input.reshape(U.shape), data["u_min"], data["u_max"])  # rounding only
        data["side"][...] = side.reshape(U.shape)
        exchanges = np.count_nonzero(data["side"] != data["guess"])
        data["bounded_checks"][...] = error <= LOOSE, exchanges, np.count_nonzero(side), error, turn

    def _condensed(self) -> tuple[np.ndarray, np.ndarray]:
        """The states' changes as maps (m N, n N) of all inputs' changes, and offsets (m N,)."""
        A, B, b = dynamics_of(self._data["rows"], self._form)
        nodes, m, n = B.shape
        maps = np.zeros((nodes, m, nodes * n))
        offsets = b.copy()
        for k in range(nodes):
            if k:
                maps[k] = A[k] @ maps[k - 1]
                offsets[k] += A[k] @ offsets[k - 1]
            maps[k, :, k * n : (k + 1) * n] = B[k]
        return maps.reshape(-1, nodes * n), offsets.ravel()


def bounded_minimum(
    H: np.ndarray, g: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Minimum of 1/2 u'Hu + g'u with low <= u <= high: u (m,); side, -1 at the lower, 1 at the upper bound,
    0 free; and the estimated error of u, infinite where H is singular to rounding."""
    with _one_at_a_time:
        multiplier = np.array(_daqp(g.size)(h=H, g=g, lbx=low, ubx=high)["lam_x"]).ravel()
    side = np.sign(multiplier)
    scale = np.diag(H)
    fixed = low == high
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
