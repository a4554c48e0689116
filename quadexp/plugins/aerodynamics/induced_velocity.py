"""Induced velocity of a rotor: blade-element thrust (14) equals momentum theory (17) (Lei & Li 2017).

    g(V_I) = K V_I sqrt(V_h^2 + u^2) - (a - b u) = 0,     u = V_I - V_z,   K = 2 rho pi r^2

The paper assumes V_I > V_z (13). Where such a root exists it is the largest one, the only one in [max(V_z, 0), V_z +
a/b], and g is convex right of it. Otherwise u < 0 and the root lies below V_z. The model's solution is therefore always
the LARGEST root: Newton's method from an upper bound converges to it monotonically where g is convex and increasing;
where a step leaves the bracket, the bracket is halved.

g has more than one root only where g' < 0 somewhere, in descents steeper than V_z = 2.83 V_h; with h = sqrt(2) V_h, g'
is smallest at u = -h sinh(asinh(V_z / h) / 3). If the largest root has V_I > V_z, the paper's assumption selects it; if
several roots all lie below V_z, in the rotor's own wake, momentum theory has no unique solution, which
`solution_function` reports as NOT_UNIQUE. For a stopped rotor in moving air the advance ratio V_h / (w r) is not
defined (STOPPED). The plain fixed-point iteration of Remark 2 (ii) diverges in hover.
"""

from __future__ import annotations

from enum import IntEnum
from functools import cache
from typing import NamedTuple

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression, named_function, named_symbols
from quadexp.physics.rotor import RotorGeometry
from quadexp.plugins.aerodynamics.blade_element import (
    ADOPTED,
    TINY_SPEED,
    CrossTerms,
    thrust_loss_per_flow,
    unloaded_thrust,
)
from quadexp.plugins.aerodynamics.coefficients import STANDING

SAFE_ITERATIONS = 60  # halving alone reaches 1e-12 m/s from any bracket in 50


class Defined(IntEnum):
    """Whether the model is defined: OK, or the reason why not."""

    OK = 0
    NOT_UNIQUE = 1
    STOPPED = 2
    NOT_FINITE = 3


REASONS = {
    Defined.NOT_UNIQUE: "descending through its own wake it has more than one induced velocity",
    Defined.STOPPED: "it is stopped in moving air, where the advance ratio V_h / (w r) is not defined",
    Defined.NOT_FINITE: "its air speed or rotor speed is not a finite number",
}


class Balance(NamedTuple):
    """Coefficients of g. K: kg/m. a: N. b: N s/m. in_plane_squared V_h^2: m^2/s^2. axial V_z: m/s, positive down."""

    K: float
    a: ca.SX
    b: ca.SX
    in_plane_squared: ca.SX
    axial: ca.SX

    def value(self, induced: Expression) -> Expression:
        """g (N) at the induced velocity (m/s)."""
        u = induced - self.axial
        return self.K * induced * self._speed(u) - (self.a - self.b * u)

    def slope(self, induced: Expression) -> Expression:
        """dg / dV_I (N s/m)."""
        u = induced - self.axial
        speed = self._speed(u)
        return self.K * (speed + induced * u / speed) + self.b

    def derivative(self, induced: Expression, by: Expression) -> Expression:
        """dV_I / d(by) of the solution, (n, p): -(dg/d(by)) / (dg/dV_I), the iterations are not differentiated."""
        return -ca.jacobian(self.value(induced), by) / ca.repmat(self.slope(induced), 1, by.numel())

    def _speed(self, u: Expression) -> Expression:
        return ca.sqrt(self.in_plane_squared + u * u + TINY_SPEED**2)


def balance(
    geometry: RotorGeometry, lift_slope: Expression, w: Expression, in_plane_squared: Expression, axial: Expression,
    terms: CrossTerms = ADOPTED,
) -> Balance:  # fmt: skip
    """The thrust balance of rotors turning at w (rad/s), scalars or vectors (n,); see `Balance`."""
    a = unloaded_thrust(geometry, lift_slope, w, in_plane_squared, terms)
    return Balance(geometry.momentum_factor, a, thrust_loss_per_flow(geometry, lift_slope, w), in_plane_squared, axial)


def starting_point(equation: Balance) -> Expression:
    """An estimate of V_I (m/s), exact where V_h = 0; two Newton steps bring it within 2e-4 m/s in cruise.

    V_I > V_z (13): the smaller of two upper bounds, the solution without in-plane speed, K V_I u = a - b u, and a
    Newton step from max(V_z, 0), which is Glauert's V_I = T / (K |V|) at high speed. Else a Newton step from 0.
    """
    K, a, b, _, axial = equation
    vertical = (K * axial - b + ca.sqrt((K * axial + b) ** 2 + 4 * K * a)) / (2 * K)
    descent = ca.fmax(axial, 0)
    above = equation.value(descent) < 0
    from_zero = -equation.value(0.0) / equation.slope(0.0)
    from_descent = descent - equation.value(descent) / equation.slope(descent)
    return ca.if_else(above, ca.fmin(vertical, from_descent), ca.fmin(from_zero, descent))


def newton(equation: Balance, start: Expression, iterations: int) -> Expression:
    """Plain Newton iterations from `start` (m/s)."""
    induced = start
    for _ in range(iterations):
        induced = induced - equation.value(induced) / equation.slope(induced)
    return induced


def safe_newton(equation: Balance, iterations: int = SAFE_ITERATIONS) -> Expression:
    """The largest root, from the upper bound, by safeguarded Newton."""
    low, high = bracket(equation)
    induced = high
    for _ in range(iterations):
        value, slope = equation.value(induced), equation.slope(induced)
        low, high = ca.if_else(value > 0, low, induced), ca.if_else(value > 0, induced, high)
        step = induced - value / slope
        induced = ca.if_else(ca.logic_and(step >= low, step <= high), step, (low + high) / 2)
    return induced


def bracket(equation: Balance) -> tuple[Expression, Expression]:
    """Bounds (m/s) of all roots: g <= 0 at the lower, g >= 0 at and above the upper one.

    The upper one: from V_I = max(V_z, 0) + sqrt(a / K) on, both V_I and u are at least sqrt(a / K), and K V_I u >= a.
    """
    a = ca.fmax(equation.a, 0)  # negative with identified coefficients only
    return ca.fmin(equation.axial, 0), ca.fmax(equation.axial, 0) + ca.sqrt(a / equation.K)


def root_is_unique(equation: Balance, induced: Expression) -> Expression:
    """Whether the largest root `induced` (m/s) is selected uniquely: V_I >= V_z (13), or there is no other root.

    g is concave left of its inflection and convex right of it. A largest root on the left is the only root; one on the
    right is the only root if the maximum of g on the left is negative.
    """
    scale = ca.sqrt(2 * equation.in_plane_squared)  # zero makes the inflection NaN, but then V_I > V_z
    inflection = equation.axial - scale * ca.sinh(ca.asinh(equation.axial / scale) / 3)
    lower, upper = ca.SX(0), inflection  # V_I < V_z only with V_z > 0, and then all roots are positive
    for _ in range(SAFE_ITERATIONS):
        middle = (lower + upper) / 2
        rising = equation.slope(middle) > 0
        lower, upper = ca.if_else(rising, middle, lower), ca.if_else(rising, upper, middle)
    alone = ca.logic_or(induced < inflection, equation.value(lower) < 0)
    return ca.logic_or(induced >= equation.axial, alone)


@cache
def solution_function(geometry: RotorGeometry, terms: CrossTerms = ADOPTED) -> ca.Function:
    """(C_la, w (rad/s), V_h^2 (m^2/s^2), V_z (m/s, positive down)) -> V_I (m/s), Defined; accurate to rounding."""
    inputs = named_symbols(ca.SX, {"lift_slope": 1, "w": 1, "in_plane_squared": 1, "axial": 1})
    lift_slope, w, squared, axial = inputs.values()
    equation = balance(geometry, lift_slope, w, squared, axial, terms)
    induced = safe_newton(equation)
    moving = squared + axial * axial > 0
    stopped, unique = w <= STANDING, root_is_unique(equation, induced)
    finite = abs(lift_slope) + abs(w) + squared + abs(axial) < ca.inf
    status = ca.if_else(unique, int(Defined.OK), int(Defined.NOT_UNIQUE))
    status = ca.if_else(stopped, ca.if_else(moving, int(Defined.STOPPED), int(Defined.OK)), status)
    status = ca.if_else(finite, status, int(Defined.NOT_FINITE))
    induced = ca.if_else(ca.logic_and(stopped, ca.logic_not(moving)), 0, induced)
    induced, status = ca.cse([induced, status])
    return named_function("induced_velocity", inputs, {"induced_velocity": induced, "status": status})
