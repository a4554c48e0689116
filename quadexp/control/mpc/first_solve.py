"""The first control step from a poor guess: Gauss-Newton directions with a line search on the nonlinear cost.

The states follow from the measured state and the inputs by the discrete dynamics, so the cost is a function J(U) of the
inputs alone, with bounds on U. The solution d of the bounded subproblem at such a trajectory is a direction of descent,
J'(U) d <= -|d|_R^2, and U + a d is within the bounds for 0 < a <= 1. The step length a is halved until

    J(U + a d) < J(U) - ARMIJO a |d|_R^2                                           (Armijo 1966)

so every limit point is stationary. Gauss-Newton converges slowly where the residual is large; Anderson acceleration of
the full steps (Walker and Ni 2011) is tried after each and kept if its cost is lower. Near the solution differences of
J are below rounding; there a step is accepted by the optimality residual instead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.interpreted import Horizon
from quadexp.control.mpc.node import Form
from quadexp.control.mpc.prediction import node_function
from quadexp.control.mpc.step import Step
from quadexp.models.residual import Residual
from quadexp.physics.expression import named_function
from quadexp.physics.vehicle import Vehicle

ROLLOUT = (
    "x0", "U", "X_ref", "U_ref", "theta", "Q", "Q_end", "R", "dt", "u_min", "u_max", "tau", "first_share",
    "disturbance",
)  # fmt: skip
CONVERGED = 1e-6  # optimality residual of a stationary point
ARMIJO = 1e-4  # share of the decrease promised by the quadratic model that a step must keep
HALVINGS = 20  # of the step length, at most
MEMORY = 6  # full steps combined by Anderson acceleration
REDUCED = 0.1  # relative decrease of the optimality residual that a full step must give where J cannot decide


class Direction(NamedTuple):
    """Change of the inputs, (N, n) (N), from the linearisation point; how it was found; optimality residual there."""

    d_input: np.ndarray
    status: Status
    sweeps: int
    active: int
    kkt: float


def rollout_function(vehicle: Vehicle, residual: Residual, form: Form, nodes: int) -> ca.Function:
    """The trajectory of given inputs, and its cost.

    Inputs: ROLLOUT, named and shaped as the step's. Outputs: X (m, N + 1); cost, half of the weighted sum of squares of
    control.mpc.step.
    """
    horizon = Horizon(form, nodes, ca.MX, ROLLOUT)
    a = horizon.given
    node = node_function(vehicle, residual, lag=form.lag, added=form.deviation, disturbed=form.disturbed)
    constant = [a["tau"]] * form.lag
    pushed = [a["disturbance"]] * form.disturbed
    states = [a["x0"]]
    for k, u in enumerate(ca.horzsplit(a["U"])):
        states.append(node(states[-1], u, a["theta"], a["dt"][k], *constant, *horizon.added[k : k + 1], *pushed))
    X = ca.horzcat(*states)
    errors = [horizon.error.deviation(k, d) for k, d in enumerate(ca.horzsplit(X - horizon.X_ref))]
    weighed = ca.horzcat(a["Q"], a["Q_end"]) * ca.horzcat(*errors) ** 2
    cost = ca.sum2(ca.sum1(weighed)) + ca.sum2(ca.sum1(a["R"] * (a["U"] - horizon.U_ref) ** 2))
    return named_function("mpc_rollout", a, {"X": X, "cost": cost / 2})


class FirstSolve:
    """Descends from a guess of the inputs to a stationary point.

    rollout: see `rollout_function`. step: its arguments are read, and X, U are where the linearisation is wanted.
    direction: linearises at the step's X, U and solves the bounded subproblem there.
    """

    def __init__(self, rollout: ca.Function, step: Step, direction: Callable[[], Direction]) -> None:
        arguments = step.arguments
        shared = {name: arguments[name] for name in rollout.name_in() if name != "U"}
        self._rollout = BufferedFunction(rollout, shared)
        self._direction = direction
        self._X = arguments["X"]
        self._U = arguments["U"]
        self._R = arguments["R"]
        self._low = arguments["u_min"]
        self._high = arguments["u_max"]

    def cost(self, inputs: np.ndarray) -> float:
        """J of inputs (N, n) (N); infinite where it is not finite."""
        self._rollout.arguments["U"][...] = inputs
        self._rollout()
        cost = float(self._rollout.results["cost"].item())
        return cost if np.isfinite(cost) else np.inf

    def solve(self, guesses: list[np.ndarray], iterations: int) -> Direction | None:
        """Descend from the guess (N, n) with the lowest cost; the trajectory is left in the step's X and U.

        Returns the last linearisation; its kkt tells whether the point is stationary. None, with X and U unchanged, if
        no guess has a finite trajectory.
        """
        cost, U = min(((self.cost(guess), guess) for guess in guesses), key=lambda pair: pair[0])
        if not np.isfinite(cost):
            return None
        linearised = self._linearise(U)
        points: list[np.ndarray] = []
        steps: list[np.ndarray] = []
        for _ in range(iterations):
            if linearised.status == Status.FAILED or linearised.kkt < CONVERGED:
                break
            d = linearised.d_input.copy()
            length, lower = self._search(U, d, cost)
            if not length:
                better = self._by_residual(U, d, linearised.kkt)
                if better is None:
                    linearised = self._linearise(U)
                    break
                U, linearised = better
                cost = self.cost(U)
                points = []
                steps = []
                continue
            if length < 1:
                points = []
                steps = []
            else:
                points = [*points, U.ravel()][-MEMORY:]
                steps = [*steps, d.ravel()][-MEMORY:]
            U = U + length * d
            cost = lower
            combined = self._accelerated(points, steps)
            if combined is not None and (lower := self.cost(combined)) < cost:
                U = combined
                cost = lower
            linearised = self._linearise(U)
        return linearised

    def _linearise(self, U: np.ndarray) -> Direction:
        self.cost(U)
        self._X[...] = self._rollout.results["X"]
        self._U[...] = U
        return self._direction()

    def _search(self, U: np.ndarray, d: np.ndarray, cost: float) -> tuple[float, float]:
        """Step length that satisfies the condition, and the cost there; (0, cost) if there is none."""
        length = 1.0
        slope = float((self._R * d * d).sum())
        for _ in range(HALVINGS):
            lower = self.cost(U + length * d)
            if lower < cost - ARMIJO * length * slope:
                return length, lower
            length /= 2
        return 0.0, cost

    def _by_residual(self, U: np.ndarray, d: np.ndarray, kkt: float) -> tuple[np.ndarray, Direction] | None:
        """The longest of some halved steps with a smaller optimality residual; None if there is none."""
        for length in 0.5 ** np.arange(8):
            candidate = U + length * d
            linearised = self._linearise(candidate)
            if linearised.status != Status.FAILED and linearised.kkt < (1 - REDUCED * length) * kkt:
                return candidate, linearised
        return None

    def _accelerated(self, points: list[np.ndarray], steps: list[np.ndarray]) -> np.ndarray | None:
        """Anderson's combination of the last full steps, clipped to the bounds; None with fewer than two."""
        if len(points) < 2:
            return None
        d_points = np.diff(points, axis=0).T
        d_steps = np.diff(steps, axis=0).T
        share = np.linalg.lstsq(d_steps, steps[-1], rcond=1e-10)[0]
        combined = points[-1] + steps[-1] - (d_points + d_steps) @ share
        return np.clip(combined.reshape(self._U.shape), self._low, self._high)
