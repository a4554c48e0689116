"""Lumped blade-element coefficients along z, fitted through the induced velocity that depends on them.

    f(theta) = sum_k a_k scale - loss sum_k w_k y_k(theta) + advance n V_h^2 - body v_z ||v||

Gauss-Newton with df/dtheta through y, which solves momentum theory at the model's own thrust. At the minimum f is
linearised: its Jacobian are the regressors whose coefficients, intervals and recursion are reported. (Taking y as a
given leaves a bias in body: quadexp.learn.rls_step, `gauss_newton`.)
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from quadexp.air.term_equations import ITERATIONS, TERMS, Air, Inflow, thrust_balance
from quadexp.errors import DataError
from quadexp.learn.huber import HUBER, MAD_TO_STD
from quadexp.learn.lumped import SELF_CONSISTENT
from quadexp.physics.induced_velocity import safe_newton

NAMES = SELF_CONSISTENT[2]
AT_ONCE = 20_000  # rows that one call evaluates
FIRST = (0.0, 0.1, 0.0, 0.0)  # scale, loss, advance, body
LEAST_LOSS = 1e-3
MOST_ROWS = 8_000  # of the search; more are thinned evenly, the last step takes them all


class ThrustFit(NamedTuple):
    """inflow: for the terms. design: df/dtheta, (k, 4). target: (k,), of the linear regression at the minimum."""

    inflow: Inflow
    design: np.ndarray
    target: np.ndarray


@cache
def _force_function(rotors: int, kappa: float) -> ca.Function:
    """(v (3,), a (n,), theta (4,)) -> f, df/dtheta (1, 4).

    With g(V, theta) = 0 the balance, dV/dtheta = -(dg/dtheta) / (dg/dV); no derivative goes through the iterations.
    """
    v, a, theta = ca.SX.sym("v", 3), ca.SX.sym("a", rotors), ca.SX.sym("theta", len(NAMES))
    V = ca.SX.sym("V", rotors)
    air = Air(v, a, Inflow(kappa, theta[1], theta[2], theta[0]), V)
    equation = thrust_balance(air)
    force = sum(theta[j] * TERMS[name](air, 2) for j, name in enumerate(NAMES))
    g = equation.value(V)
    through = -ca.jacobian(g, theta) / ca.repmat(equation.slope(V), 1, len(NAMES))
    slope = ca.jacobian(force, theta) + ca.mtimes(ca.jacobian(force, V), through)
    solved = ca.substitute([force, slope], [V], [safe_newton(equation, ITERATIONS)])
    return ca.Function("force", [v, a, theta], ca.cse(solved))


def fit_inflow(
    velocity: np.ndarray, rotor_acceleration: np.ndarray, target: np.ndarray, kappa: float, loss: str = "squares"
) -> ThrustFit:
    """Fit target (k,), specific force along z beyond the thrust curve (m/s^2).

    velocity: (k, 3) m/s. rotor_acceleration: (k, n) m/s^2. kappa: 1/m. loss: "squares" or "huber".
    Raises DataError where the flights do not show that flow through the rotors costs thrust.
    """
    from scipy.optimize import least_squares

    function = _force_function(rotor_acceleration.shape[1], float(kappa))
    thin = slice(None, None, -(-len(target) // MOST_ROWS))
    some = velocity[thin].T, rotor_acceleration[thin].T

    seen: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}  # the search asks for both at one theta

    def at(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if theta.tobytes() not in seen:
            value, jacobian = function(*some, theta)
            seen.clear()
            seen[theta.tobytes()] = np.array(value).ravel() - target[thin], _rows(jacobian, len(NAMES))
        return seen[theta.tobytes()]

    def residual(theta: np.ndarray) -> np.ndarray:
        return at(theta)[0]

    def slope(theta: np.ndarray) -> np.ndarray:
        return at(theta)[1]

    bounds = ([-0.5, LEAST_LOSS, -np.inf, -np.inf], [1.0, np.inf, np.inf, np.inf])
    options = {"jac": slope, "bounds": bounds, "x_scale": "jac", "xtol": 1e-10, "ftol": 1e-12, "gtol": 1e-10}
    found = least_squares(residual, FIRST, **options)
    if loss == "huber":
        limit = HUBER * MAD_TO_STD * float(np.median(np.abs(found.fun)))
        found = least_squares(residual, found.x, loss="huber", f_scale=max(limit, 1e-12), **options)
    theta = found.x
    if theta[1] < 2 * LEAST_LOSS:
        raise DataError("blade element along z: the flights do not show that flow through the rotors costs thrust")
    force, design = np.empty(len(target)), np.empty((len(target), len(NAMES)))
    for start in range(0, len(target), AT_ONCE):
        rows = slice(start, start + AT_ONCE)
        value, jacobian = function(velocity[rows].T, rotor_acceleration[rows].T, theta)
        force[rows], design[rows] = np.array(value).ravel(), _rows(jacobian, len(NAMES))
    inflow = Inflow(float(kappa), float(theta[1]), float(theta[2]), float(theta[0]))
    return ThrustFit(inflow, design, target - force + design @ theta)


def _rows(jacobian: ca.DM, p: int) -> np.ndarray:
    """(k, p) of the (1, k p) that a mapped function returns."""
    return np.array(jacobian).reshape(-1, p)
