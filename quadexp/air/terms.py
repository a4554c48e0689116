"""Residual acceleration as a sum of named terms: linear or quadratic drag, or blade element with lumped coefficients.

    a_body,i = sum_j c_ij phi_ij(v, a),    a = u / m                            body FLU, m/s^2

The coefficients c are runtime parameters; the set of terms, the mass and the inflow parameters are structure. Each phi
is written here once, in CasADi, as a function of the air-relative body velocity v (m/s) and of the acceleration a_k
that each rotor's thrust gives (m/s^2), so that a model fitted to a log serves a plant or a controller too. With n
rotors, w_k = sqrt(a_k) (sqrt(m/s^2): rotor speed times sqrt(k_T / m)), V_h^2 = v_x^2 + v_y^2, and V_k the induced
velocity of momentum theory at that thrust:

    linear      -v_i                offset      1
    quadratic   -v_i |v_i|          body        -v_i ||v||
    hub         -v_i sum_k w_k      hub_climb   -v_i n v_z
    thrust      sum_k a_k           climb       -v_z sum_k w_k
    advance     n V_h^2             induced     -sum_k w_k (V_k - V_k,hover)
    hub_inflow  -v_i sum_k y_k      inflow      -sum_k w_k y_k
    hub_square  -v_i sum_k y_k^2 / w_k          y_k = V_k + v_z - V_k,hover

Linear drag: Faessler et al. 2018. Lumped blade element: quadexp.models.lumped.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from quadexp.air.base import Residual, feature_names, symbolic_residual
from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.physics.blade_element import TINY_SPEED
from quadexp.physics.expression import Expression
from quadexp.physics.induced_velocity import Balance, safe_newton
from quadexp.physics.vehicle import Vehicle

LEAST_ACCELERATION = 1e-6  # m/s^2 per rotor: lower bound under the square root, which keeps it differentiable
ITERATIONS = 16  # of the safeguarded Newton method, started at its upper bound


class TermStructure(NamedTuple):
    """terms: names per axis. mass: kg. momentum: kappa (1/m), 0 where unknown, or the four numbers of an `Inflow`."""

    terms: tuple[tuple[str, ...], ...]
    mass: float
    momentum: float | tuple[float, ...] = 0.0

    @property
    def n_parameters(self) -> int:
        return sum(map(len, self.terms))


class Inflow(NamedTuple):
    """Parameters of the induced velocity: kappa V sqrt(V_h^2 + u^2) = a (1 + scale) + advance V_h^2 - loss w y.

    u = V + v_z: flow through the rotor (m/s); y = u - V_hover: its excess over that in hover (m/s), with
    V_hover^2 = a (1 + scale) / kappa. kappa = 2 rho pi r^2 / m (1/m), 0 where unknown. loss (1/sqrt(m)), advance (1/m),
    scale: the z coefficients of the model itself. All three zero: the thrust is taken as the static one.
    """

    kappa: float = 0.0
    loss: float = 0.0
    advance: float = 0.0
    scale: float = 0.0


class OperatingPoint(NamedTuple):
    """v: (3,) m/s. a: (n,) m/s^2. V: induced velocity, (n,) (m/s); None: solved for."""

    v: ca.SX
    a: ca.SX
    inflow: Inflow
    V: ca.SX | None = None


def _rotor_speed(point: OperatingPoint) -> Expression:
    """w = sqrt(a), (n,) (sqrt(m/s^2))."""
    return ca.sqrt(ca.fmax(point.a, LEAST_ACCELERATION))


def _speed(point: OperatingPoint) -> Expression:
    return ca.sqrt(ca.dot(point.v, point.v) + TINY_SPEED**2)


def _hover_inflow(point: OperatingPoint) -> Expression:
    """Induced velocity in hover, (n,) (m/s)."""
    return ca.sqrt(ca.fmax(point.a, LEAST_ACCELERATION) * (1 + point.inflow.scale) / point.inflow.kappa)


def thrust_balance(point: OperatingPoint) -> Balance:
    """The equation of V, per mass, as `Inflow` states it."""
    a, w = ca.fmax(point.a, LEAST_ACCELERATION), _rotor_speed(point)
    kappa, loss, advance, scale = point.inflow
    squared = point.v[0] ** 2 + point.v[1] ** 2
    unloaded = a * (1 + scale) + advance * squared + loss * w * _hover_inflow(point)
    return Balance(kappa, unloaded, loss * w, squared, -point.v[2])


def _induced(point: OperatingPoint) -> Expression:
    """V - V_hover, (n,) (m/s)."""
    V = safe_newton(thrust_balance(point), ITERATIONS) if point.V is None else point.V
    return V - _hover_inflow(point)


def _excess(point: OperatingPoint) -> Expression:
    """y = V + v_z - V_hover, (n,) (m/s)."""
    return _induced(point) + point.v[2]


TERMS = {
    "linear": lambda point, i: -point.v[i],
    "offset": lambda point, i: ca.SX(1),
    "quadratic": lambda point, i: -point.v[i] * ca.fabs(point.v[i]),
    "body": lambda point, i: -point.v[i] * _speed(point),
    "hub": lambda point, i: -point.v[i] * ca.sum1(_rotor_speed(point)),
    "hub_climb": lambda point, i: -point.v[i] * point.a.numel() * point.v[2],
    "hub_inflow": lambda point, i: -point.v[i] * ca.sum1(_excess(point)),
    "hub_square": lambda point, i: -point.v[i] * ca.sum1(_excess(point) ** 2 / _rotor_speed(point)),
    "thrust": lambda point, i: ca.sum1(point.a),
    "climb": lambda point, i: -point.v[2] * ca.sum1(_rotor_speed(point)),
    "advance": lambda point, i: point.a.numel() * (point.v[0] ** 2 + point.v[1] ** 2),
    "induced": lambda point, i: -ca.dot(_rotor_speed(point), _induced(point)),
    "inflow": lambda point, i: -ca.dot(_rotor_speed(point), _excess(point)),
}
NEED_RADIUS = ("induced", "inflow", "hub_inflow", "hub_square")


def term_expression(
    name: str, axis: int, v: Expression, a: Expression, momentum: float | tuple[float, ...] = 0.0
) -> Expression:
    """One phi, scalar; v (3,) m/s, a (n,) m/s^2. momentum: kappa alone (1/m), or the four numbers of an `Inflow`.

    Raises UsageError for a term with induced velocity where kappa is unknown.
    """
    inflow = Inflow(*momentum) if isinstance(momentum, (tuple, list)) else Inflow(momentum)
    if name in NEED_RADIUS and isinstance(inflow.kappa, float | int) and not inflow.kappa > 0:
        raise UsageError(f"term '{name}' needs the rotors' radius and the vehicle's mass")
    return TERMS[name](OperatingPoint(v, a, inflow), axis)


@cache
def columns_function(
    terms: tuple[tuple[str, ...], ...], rotors: int, momentum: float | tuple[float, ...] = 0.0
) -> ca.Function:
    """(v (3,), a (n,)) -> the phi of all axes one after the other; terms: names per axis."""
    v, a = ca.SX.sym("v", 3), ca.SX.sym("a", rotors)
    phi = [term_expression(name, axis, v, a, momentum) for axis, names in enumerate(terms) for name in names]
    return ca.Function("terms", [v, a], [ca.densify(ca.cse(ca.vertcat(*phi)))])


def term_acceleration(features: Expression, theta: Expression, structure: TermStructure) -> Expression:
    """a_body, (3,) (m/s^2), of z = [v_body, w, u] and theta, the coefficients of all axes one after the other."""
    v, a = features[:3], features[6:] / structure.mass
    components, k = [], 0
    for axis, names in enumerate(structure.terms):
        total = ca.SX(0)
        for name in names:
            total += theta[k] * term_expression(name, axis, v, a, structure.momentum)
            k += 1
        components.append(total)
    return ca.vertcat(*components)


def term_residual(vehicle: Vehicle, structure: TermStructure, coefficients: np.ndarray, source: str = "") -> Residual:
    """Residual of the terms; coefficients of all axes, (p,). source: for the record."""
    features = ca.SX.sym("z", len(feature_names(vehicle.n_rotors)))
    theta = ca.SX.sym("theta", structure.n_parameters)
    outputs = ca.vertcat(term_acceleration(features, theta, structure), ca.SX(3, 1))
    return symbolic_residual("identified", outputs, features, theta, coefficients, source=source)
