"""Blade-element forces with lumped coefficients: the regression for rotors whose geometry is unknown.

From quadexp.physics.blade_element (Lei & Li 2017, equations 9, 10, 14, 15), with s = N_b rho c / 2, climb v_z = -V_z,
flow through the rotor u_k = V_k + v_z, and the airframe's drag (6), the specific force is

    f_z     = (s C_la / m) [ r^3 th/3 sum w^2 + A r th n V_h^2 - r^2/2 sum w (V + v_z) ] - rho S C_Dz/(2m) ||v|| v_z
    f_{x,y} = -(v_i/m) [ s r^2 C_d0/2 sum w - s B r th C_la sum u + s C_la/2 sum u^2/w ] - rho S C_Di/(2m) ||v|| v_i

In hover V_k = nu w_k (Remark 4). With y_k = V_k + v_z - nu w_k, the flow through the rotor beyond that in hover,

    f_z     = [k_T,static/m] sum w^2 - [k_3/m] sum w y + [k_2/m] n V_h^2 - [k_4/m] v_z ||v||
    f_{x,y} = -[h_1/m] v_i sum w - [h_2/m] v_i sum y - [h_3/m] v_i sum y^2/w - [k_4/m] v_i ||v||

    k_T,static = s C_la (r^3 th/3 - r^2 nu/2)        k_3 = s C_la r^2/2        k_2 = s C_la A r th
    h_1 = s (r^2 C_d0/2 - B r th C_la nu + C_la nu^2/2)        h_2 = s C_la (nu - B r th)        h_3 = s C_la/2
    k_4 = rho S C_D/2, per axis

which is the blade-element model exactly, with lumped coefficients. Rotor speeds are not needed: w = sqrt(a / k), with a
the thrust curve's acceleration of a rotor and k = k_T,static/m. For a logged rotor speed this is exact, for a command
an approximation. The terms of quadexp.models.terms therefore have the coefficients (k in 1/m; sqrt(k) converts w from
rad/s to sqrt(m/s^2))

    thrust     correction of the curve's scale           hub         h_1 / (m sqrt(k))
    inflow     k_3 / (m sqrt(k))                         hub_inflow  h_2 / m
    advance    k_2 / m                                   hub_square  h_3 sqrt(k) / m
    body       k_4 / m

SELF_CONSISTENT: V_k follows from momentum theory (17) at the rotor's thrust, kappa V sqrt(V_h^2 + u^2) = T/m with
kappa = 2 rho pi r^2/m, which takes the rotor's radius. T is the model's own thrust, so along z

    f(theta) = sum_k a_k scale - loss sum_k w_k y_k(theta) + advance n V_h^2 - body v_z ||v||

is fitted by Gauss-Newton with df/dtheta through y (`fit_inflow`). At the minimum f is linearised; its Jacobian gives
the regressors whose coefficients, intervals and recursion are reported. (Holding y fixed would bias `body`; compare
gauss_newton in quadexp.models.rls.)

WITHOUT_RADIUS: where the radius is unknown, V_k - V_hover is left out, its mean is absorbed by `climb` and `advance`,
and hub_climb, -v_i n v_z, replaces the two terms in y. The rotors' own velocities (omega x r_k) cancel from the sums to
first order. Offsets: see quadexp.models.terms.
"""

from __future__ import annotations

import math
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import DataError
from quadexp.models.dataset import BATCH
from quadexp.models.regression import HUBER, MAD_TO_STD
from quadexp.models.terms import ITERATIONS, TERMS, Z_TERMS, Inflow, OperatingPoint
from quadexp.physics.induced_velocity import safe_newton
from quadexp.physics.vehicle import Vehicle

AIR_DENSITY = 1.2  # kg/m^3, where the vehicle does not state one
START = (0.0, 0.1, 0.0, 0.0)  # scale, loss, advance, body
LEAST_LOSS = 1e-3
SEARCH_SAMPLES = 8_000  # used by the search; more are thinned evenly. The linearisation uses all.


class ThrustFit(NamedTuple):
    """inflow: for the terms. design: df/dtheta, (k, 4). target: (k,), of the linear regression at the minimum."""

    inflow: Inflow
    design: np.ndarray
    target: np.ndarray


def momentum_of(vehicle: Vehicle | None, mass: float | None, radius: float | None) -> float:
    """kappa = 2 rho pi r^2 / m (1/m), 0 where radius or mass is unknown; mass (kg), radius (m) override the vehicle."""
    geometry = vehicle.rotor_geometry if vehicle and vehicle.rotor else None
    mass = mass or (vehicle.mass if vehicle else None)
    if radius is None:
        return geometry.momentum_factor / mass if geometry and mass else 0.0
    density = geometry.air_density if geometry else AIR_DENSITY
    return 2 * density * math.pi * radius**2 / mass if mass else 0.0


@cache
def _force_function(rotors: int, kappa: float) -> ca.Function:
    """(v (3,), a (n,), theta (4,)) -> f, df/dtheta (1, 4).

    With the balance g(V, theta) = 0, dV/dtheta = -(dg/dtheta) / (dg/dV): the iterations are not differentiated.
    """
    v, a, theta = ca.SX.sym("v", 3), ca.SX.sym("a", rotors), ca.SX.sym("theta", len(Z_TERMS))
    V = ca.SX.sym("V", rotors)
    point = OperatingPoint(v, a, Inflow(kappa, theta[1], theta[2], theta[0]), V)
    equation = point.balance
    force = sum(theta[j] * TERMS[name].phi(point, 2) for j, name in enumerate(Z_TERMS))
    g = equation.value(V)
    dV_dtheta = -ca.jacobian(g, theta) / ca.repmat(equation.slope(V), 1, len(Z_TERMS))
    slope = ca.jacobian(force, theta) + ca.mtimes(ca.jacobian(force, V), dV_dtheta)
    solved = ca.substitute([force, slope], [V], [safe_newton(equation, ITERATIONS)])
    return ca.Function("force", [v, a, theta], ca.cse(solved))


def fit_inflow(
    velocity: np.ndarray, rotor_acceleration: np.ndarray, target: np.ndarray, kappa: float, loss: str = "squares"
) -> ThrustFit:
    """Fit the four z coefficients to target (k,), the specific force along z beyond the thrust curve (m/s^2).

    velocity: (k, 3) m/s. rotor_acceleration: (k, n) m/s^2. kappa: 1/m. loss: "squares" or "huber".
    Raises DataError where the flights do not show that flow through the rotors costs thrust.
    """
    from scipy.optimize import least_squares

    function = _force_function(rotor_acceleration.shape[1], float(kappa))
    thin = slice(None, None, -(-len(target) // SEARCH_SAMPLES))

    @lru_cache(maxsize=1)  # the search asks for the residuals and the Jacobian at the same theta
    def evaluate(theta: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
        value, jacobian = function(velocity[thin].T, rotor_acceleration[thin].T, np.array(theta))
        return np.array(value).ravel() - target[thin], np.array(jacobian).reshape(-1, len(Z_TERMS))

    options = {
        "jac": lambda theta: evaluate(tuple(theta))[1], "x_scale": "jac", "xtol": 1e-10, "ftol": 1e-12, "gtol": 1e-10,
        "bounds": ([-0.5, LEAST_LOSS, -np.inf, -np.inf], [1.0, np.inf, np.inf, np.inf]),
    }  # fmt: skip
    result = least_squares(lambda theta: evaluate(tuple(theta))[0], START, **options)
    if loss == "huber":
        limit = HUBER * MAD_TO_STD * float(np.median(np.abs(result.fun)))
        result = least_squares(
            lambda theta: evaluate(tuple(theta))[0], result.x, loss="huber", f_scale=max(limit, 1e-12), **options
        )
    theta = result.x
    if theta[1] < 2 * LEAST_LOSS:
        raise DataError("blade element along z: the flights do not show that flow through the rotors costs thrust")
    force, design = np.empty(len(target)), np.empty((len(target), len(Z_TERMS)))
    for start in range(0, len(target), BATCH):
        part = slice(start, start + BATCH)
        value, jacobian = function(velocity[part].T, rotor_acceleration[part].T, theta)
        force[part], design[part] = np.array(value).ravel(), np.array(jacobian).reshape(-1, len(Z_TERMS))
    inflow = Inflow(float(kappa), float(theta[1]), float(theta[2]), float(theta[0]))
    return ThrustFit(inflow, design, target - force + design @ theta)
