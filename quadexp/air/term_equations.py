"""The terms of quadexp.learn.terms in CasADi: each phi(v, a), with the induced velocity that some of them need."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import casadi as ca

from quadexp.errors import UsageError
from quadexp.physics.blade_element import TINY_SPEED
from quadexp.physics.expression import Expression
from quadexp.physics.induced_velocity import Balance, safe_newton

LEAST_ACCELERATION = 1e-6  # m/s^2 per rotor, below which a thrust is taken for this, so that its root has a slope
ITERATIONS = 16  # of the safeguarded Newton method, from its upper bound


class Inflow(NamedTuple):
    """What the induced velocity is solved with: kappa V sqrt(V_h^2 + u^2) = a (1 + scale) + advance V_h^2 - loss w y.

    u = V + v_z: flow through the rotor; y = u - V_hover: what it has more than in air at rest (m/s), with
    V_hover^2 = a (1 + scale) / kappa. kappa = 2 rho pi r^2 / m (1/m), 0 where unknown. loss (1/sqrt(m)), advance (1/m),
    scale: the z coefficients of the model itself; all zero takes the thrust for the static one.
    """

    kappa: float = 0.0
    loss: float = 0.0
    advance: float = 0.0
    scale: float = 0.0


class Air(NamedTuple):
    """v: (3,) m/s. a: (n,) m/s^2. V: induced velocity, (n,) (m/s), None where it is to be solved for."""

    v: ca.SX
    a: ca.SX
    inflow: Inflow
    V: ca.SX | None = None


def _root(air: Air) -> Expression:
    return ca.sqrt(ca.fmax(air.a, LEAST_ACCELERATION))


def _speed(air: Air) -> Expression:
    return ca.sqrt(ca.dot(air.v, air.v) + TINY_SPEED**2)


def _hover(air: Air) -> Expression:
    """Induced velocity in air at rest, (n,) (m/s)."""
    return ca.sqrt(ca.fmax(air.a, LEAST_ACCELERATION) * (1 + air.inflow.scale) / air.inflow.kappa)


def thrust_balance(air: Air) -> Balance:
    """The equation of V, per mass, as `Inflow` states it."""
    a, w = ca.fmax(air.a, LEAST_ACCELERATION), _root(air)
    kappa, loss, advance, scale = air.inflow
    squared = air.v[0] ** 2 + air.v[1] ** 2
    unloaded = a * (1 + scale) + advance * squared + loss * w * _hover(air)
    return Balance(kappa, unloaded, loss * w, squared, -air.v[2])


def _induced(air: Air) -> Expression:
    """V - V_hover, (n,) (m/s)."""
    V = safe_newton(thrust_balance(air), ITERATIONS) if air.V is None else air.V
    return V - _hover(air)


def _excess(air: Air) -> Expression:
    """y = V + v_z - V_hover, (n,) (m/s)."""
    return _induced(air) + air.v[2]


TERMS = {
    "linear": lambda air, i: -air.v[i],
    "offset": lambda air, i: ca.SX(1),
    "quadratic": lambda air, i: -air.v[i] * ca.fabs(air.v[i]),
    "body": lambda air, i: -air.v[i] * _speed(air),
    "hub": lambda air, i: -air.v[i] * ca.sum1(_root(air)),
    "hub_climb": lambda air, i: -air.v[i] * air.a.numel() * air.v[2],
    "hub_inflow": lambda air, i: -air.v[i] * ca.sum1(_excess(air)),
    "hub_square": lambda air, i: -air.v[i] * ca.sum1(_excess(air) ** 2 / _root(air)),
    "thrust": lambda air, i: ca.sum1(air.a),
    "climb": lambda air, i: -air.v[2] * ca.sum1(_root(air)),
    "advance": lambda air, i: air.a.numel() * (air.v[0] ** 2 + air.v[1] ** 2),
    "induced": lambda air, i: -ca.dot(_root(air), _induced(air)),
    "inflow": lambda air, i: -ca.dot(_root(air), _excess(air)),
}
NEED_RADIUS = ("induced", "inflow", "hub_inflow", "hub_square")


def term_expression(
    name: str, axis: int, v: Expression, a: Expression, momentum: float | tuple[float, ...] = 0.0
) -> Expression:
    """One phi, scalar, in CasADi; v (3,) m/s, a (n,) m/s^2. momentum: kappa alone, or an Inflow's four numbers."""
    inflow = Inflow(*momentum) if isinstance(momentum, (tuple, list)) else Inflow(momentum)
    if name in NEED_RADIUS and isinstance(inflow.kappa, float | int) and not inflow.kappa > 0:
        raise UsageError(f"term '{name}' needs the rotors' radius and the vehicle's mass")
    return TERMS[name](Air(v, a, inflow), axis)


@cache
def columns_function(
    names: tuple[str, ...], axis: int, rotors: int, momentum: float | tuple[float, ...]
) -> ca.Function:
    """(v (3,), a (n,)) -> the phi of an axis, (len(names),)."""
    v, a = ca.SX.sym("v", 3), ca.SX.sym("a", rotors)
    terms = [term_expression(name, axis, v, a, momentum) for name in names]
    return ca.Function("terms", [v, a], [ca.cse(ca.vertcat(*terms))])
