"""The control problem as one nonlinear programme for IPOPT: nothing shared with the step but the dynamics."""

from __future__ import annotations

import casadi as ca
import numpy as np

from quadexp.air.base import Residual
from quadexp.control.mpc.settings import MPCSettings
from quadexp.physics.integrator import rk4_step
from quadexp.physics.motor import lagging_rk4_step
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.vehicle import Vehicle


def error_rotation(q, q_ref):
    """q_ref^-1 o q of unit quaternions, by the vector form of the product."""
    a, b = q_ref[0], -q_ref[1:]
    return ca.vertcat(a * q[0] - ca.dot(b, q[1:]), a * q[1:] + q[0] * b + ca.cross(b, q[1:]))


class ConvergedProblem:
    """Solves the whole multiple-shooting problem to convergence for a measured state and a reference.

    local: stay at the guess if it is stationary, for problems with several minima; bounds are not pushed away from.
    """

    def __init__(self, vehicle: Vehicle, residual: Residual, settings: MPCSettings, *, local: bool = False) -> None:
        N, n = settings.nodes, vehicle.n_rotors
        dynamics = corrected_function(vehicle, residual)
        m = 13 + n * bool(settings.motor_lag)
        x, u = ca.MX.sym("x", m), ca.MX.sym("u", n)
        h, share = ca.MX.sym("h"), settings.node_share
        if settings.motor_lag:
            lagging = lagging_rk4_step(lambda s, T: dynamics(s, T, residual.theta), x, u, h, settings.motor_lag)
            step = ca.Function("F", [x, u, h], [lagging])
        else:
            step = ca.Function("F", [x, u, h], [rk4_step(lambda s: dynamics(s, u, residual.theta), x, h)])
        X, U = ca.MX.sym("X", m, N + 1), ca.MX.sym("U", n, N)
        X_ref, U_ref, x0 = ca.MX.sym("X_ref", 13, N + 1), ca.MX.sym("U_ref", n, N), ca.MX.sym("x0", m)
        Q, R = settings.state_weight(), settings.thrust_weight(vehicle)
        cost = 0
        for k in range(N + 1):
            weight = share[k] * Q if k < N else settings.terminal_weight * Q
            error = X[:13, k] - X_ref[:, k]
            if settings.attitude_error == "body":
                error[3:7] = error_rotation(X[3:7, k], X_ref[3:7, k]) - ca.DM([1, 0, 0, 0])
            cost += ca.dot(weight * error, error)
        for k in range(N):
            cost += ca.dot(share[k] * R * (U[:, k] - U_ref[:, k]), U[:, k] - U_ref[:, k])
        periods = settings.node_periods
        gaps = ca.vertcat(X[:, 0] - x0, *(X[:, k + 1] - step(X[:, k], U[:, k], periods[k]) for k in range(N)))
        problem = {
            "x": ca.vertcat(ca.vec(X), ca.vec(U)),
            "p": ca.horzcat(ca.vec(X_ref).T, ca.vec(U_ref).T, x0.T),
            "f": cost,
            "g": gaps,
        }
        options = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
        if local:
            options |= {"ipopt.mu_init": 1e-11, "ipopt.bound_push": 1e-10, "ipopt.bound_frac": 1e-10}
            options |= {"ipopt.tol": 1e-8}
        self._solver = ca.nlpsol("converged", "ipopt", problem, options)
        self._split = m * (N + 1)
        free = np.full(self._split, np.inf)
        self._lower = np.r_[-free, np.full(n * N, vehicle.thrust_min)]
        self._upper = np.r_[free, np.full(n * N, vehicle.thrust_max)]
        self._n = n

    def first_input(self, x0, state_reference, input_reference, guess) -> np.ndarray:
        """Converged first input (n,) (N); guess: (states (N + 1, m), inputs (N, n))."""
        solution = self._solver(
            x0=np.r_[guess[0].reshape(-1), guess[1].reshape(-1)],
            p=np.r_[state_reference.reshape(-1), input_reference.reshape(-1), x0],
            lbx=self._lower,
            ubx=self._upper,
            lbg=0,
            ubg=0,
        )
        assert self._solver.stats()["success"]
        return np.array(solution["x"]).reshape(-1)[self._split : self._split + self._n]
