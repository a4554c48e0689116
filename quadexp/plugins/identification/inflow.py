"""The blade-element terms along z, fitted together with the induced velocity that they cause.

V_k follows from momentum theory (17) at the rotor's thrust, kappa V sqrt(V_h^2 + u^2) = T/m, kappa = 2 rho pi r^2/m,
which takes the rotor's radius. T is the model's own thrust, so along z (symbols of quadexp.plugins.aerodynamics.terms)

    f(theta) = sum_k a_k scale - loss sum_k w_k y_k(theta) + advance n V_h^2 - body v_z ||v||

is fitted by Gauss-Newton with df/dtheta through y. At the minimum f is linearised; its Jacobian gives the regressors
whose coefficients, intervals and recursion are reported. (Holding y fixed would bias `body`; compare gauss_newton in
quadexp.plugins.papers.lei_li.rls.)
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import DataError
from quadexp.models.dataset import evaluate_rows
from quadexp.physics.expression import symbols
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.induced_velocity import safe_newton
from quadexp.plugins.aerodynamics.terms import ITERATIONS, TERMS, Z_TERMS, Inflow, OperatingPoint

AIR_DENSITY = 1.2  # kg/m^3, where the vehicle does not state one
START = (0.0, 0.1, 0.0, 0.0)  # scale, loss, advance, body
LEAST_LOSS = 1e-3  # 1/m; at it, the term is none
BOUNDS = ((-0.5, LEAST_LOSS, -np.inf, -np.inf), (1.0, np.inf, np.inf, np.inf))
SEARCH_SAMPLES = 8_000  # used by the search; more are thinned evenly. The linearisation uses all.


class ThrustFit(NamedTuple):
    """inflow: for the terms. design: df/dtheta, (k, 4). target: (k,), of the linear regression at the minimum."""

    inflow: Inflow
    design: np.ndarray
    target: np.ndarray


def momentum_of(vehicle: Vehicle | None, radius: float | None) -> float:
    """kappa = 2 rho pi r^2 / m (1/m), 0 where radius or mass is unknown; radius (m): other than the vehicle's."""
    if vehicle is None:
        return 0.0
    geometry = vehicle.rotor_geometry if vehicle.rotor else None
    if radius is not None:
        density = geometry.air_density if geometry else AIR_DENSITY
        return 2 * density * math.pi * radius**2 / vehicle.mass
    return geometry.momentum_factor / vehicle.mass if geometry else 0.0


@cache
def _force_function(rotors: int, kappa: float) -> ca.Function:
    """(v (3,), a (n,), theta (4,)) -> f and df/dtheta, (5,)."""
    v, a, theta, V = symbols(ca.SX, v=3, a=rotors, theta=len(Z_TERMS), V=rotors)
    point = OperatingPoint(v, a, Inflow(kappa, theta[1], theta[2], theta[0]), V)
    equation = point.balance
    force = sum(theta[j] * TERMS[name].phi(point, 2) for j, name in enumerate(Z_TERMS))
    through_inflow = ca.jacobian(force, V) @ equation.derivative(V, theta)
    slope = ca.jacobian(force, theta) + through_inflow
    induced = safe_newton(equation, ITERATIONS)
    solved = ca.substitute(ca.vertcat(force, slope.T), V, induced)
    return ca.Function("force", [v, a, theta], [ca.densify(ca.cse(solved))])


def fit_inflow(velocity: np.ndarray, rotor_acceleration: np.ndarray, target: np.ndarray, kappa: float) -> ThrustFit:
    """Fit the four z coefficients to target (k,), the specific force along z beyond the thrust curve (m/s^2).

    velocity: (k, 3) m/s. rotor_acceleration: (k, n) m/s^2. kappa: 1/m.
    Raises DataError where the flights do not show that flow through the rotors costs thrust.
    """
    from scipy.optimize import least_squares

    function = _force_function(rotor_acceleration.shape[1], float(kappa))

    def evaluate(theta: np.ndarray, every: int) -> tuple[np.ndarray, np.ndarray]:
        """f - target, (k,), and df/dtheta, (k, 4), at every so many samples."""
        v = velocity[::every]
        a = rotor_acceleration[::every]
        values = np.empty((len(v), 1 + len(Z_TERMS)))
        thetas = np.tile(theta, (len(v), 1))
        evaluate_rows(function, (v, a, thetas), values)
        return values[:, 0] - target[::every], values[:, 1:]

    every = -(-len(target) // SEARCH_SAMPLES)
    fit = least_squares(
        lambda theta: evaluate(theta, every)[0], START, lambda theta: evaluate(theta, every)[1], BOUNDS,
        x_scale="jac", xtol=1e-10, ftol=1e-12, gtol=1e-10,
    )  # fmt: skip
    theta = fit.x
    scale, loss, advance, _ = theta.tolist()
    if loss < 2 * LEAST_LOSS:
        raise DataError("blade element along z: the flights do not show that flow through the rotors costs thrust")
    error, design = evaluate(theta, 1)
    return ThrustFit(Inflow(float(kappa), loss, advance, scale), design, design @ theta - error)
