"""The control problem as one nonlinear programme for IPOPT: nothing shared with the step but the dynamics."""

import casadi as ca
import numpy as np

from quadexp.control.mpc.settings import MPCSettings
from quadexp.models.residual import Residual
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
        h, share, tau = ca.MX.sym("h"), settings.node_share, settings.motor_lag
        samples = 2 if settings.input_hold == "deviation" else 1
        X_all, U_all = ca.MX.sym("X_ref", 13, samples * N + 1), ca.MX.sym("U_ref", n, samples * N)
        X_ref, U_ref, periods = X_all[:, ::samples], U_all, settings.node_periods
        thrusts = [ca.MX.sym(f"T{i}", n) for i in range(4)]  # the reference's in a node, and the command held for them
        if samples == 2:
            limits = vehicle.thrust_min, vehicle.thrust_max
            within = [self._limited(column, *limits) for column in ca.horzsplit(U_all)]
            within.append(2 * within[-1] - within[-2])
            profiles = [within[2 * k : 2 * k + 3] for k in range(N)]
            holds = [settings.control_period, *periods[1:]]
            profiles = [[*p, self._command(p, d, t, tau)] for p, d, t in zip(profiles, periods, holds, strict=True)]
            U_ref = ca.horzcat(*(self._limited(profile[3], *limits) for profile in profiles))
            step = self._with_profile(lambda s, T: dynamics(s, T, residual.theta), x, u, h, tau, thrusts)
        elif tau:
            lagging = lagging_rk4_step(lambda s, T: dynamics(s, T, residual.theta), x, u, h, tau)
            step = ca.Function("F", [x, u, h], [lagging])
        else:
            step = ca.Function("F", [x, u, h], [rk4_step(lambda s: dynamics(s, u, residual.theta), x, h)])
        X, U = ca.MX.sym("X", m, N + 1), ca.MX.sym("U", n, N)
        x0 = ca.MX.sym("x0", m)
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
        known = profiles if samples == 2 else [[]] * N
        predicted = (step(X[:, k], U[:, k], periods[k], *known[k]) for k in range(N))
        gaps = ca.vertcat(X[:, 0] - x0, *(X[:, k + 1] - x_next for k, x_next in enumerate(predicted)))
        problem = {
            "x": ca.vertcat(ca.vec(X), ca.vec(U)),
            "p": ca.horzcat(ca.vec(X_all).T, ca.vec(U_all).T, x0.T),
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

    @staticmethod
    def _limited(thrust, low, high):
        return ca.fmin(ca.fmax(thrust, low), high)

    @staticmethod
    def _command(profile, dt, held, tau):
        """Mean of T + tau T' over the time held, of the parabola through the three thrusts; Simpson's rule is exact."""

        def thrust(t):
            s = t / dt
            return (1 - s) * (1 - 2 * s) * profile[0] + 4 * s * (1 - s) * profile[1] + s * (2 * s - 1) * profile[2]

        mean = (thrust(0) + 4 * thrust(held / 2) + thrust(held)) / 6
        return mean + tau * (thrust(held) - thrust(0)) / held

    @staticmethod
    def _with_profile(slope, x, u, h, tau, thrusts):
        """One RK4 step under the reference's thrust and the deviation from it, which lags."""
        *profile, command = thrusts
        acting = []
        for share, T in zip((0, 0.5, 1), profile, strict=True):
            left = ca.exp(-share * h / tau) if tau else 0
            believed = x[13:] - profile[0] if tau else 0
            acting.append(T + (1 - left) * (u - command) + left * believed)
        body = x[:13]
        k1 = slope(body, acting[0])
        k2 = slope(body + h / 2 * k1, acting[1])
        k3 = slope(body + h / 2 * k2, acting[1])
        k4 = slope(body + h * k3, acting[2])
        x_next = body + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return ca.Function("F", [x, u, h, *thrusts], [ca.vertcat(x_next, acting[2]) if tau else x_next])

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
