"""One control period of the blade-element plant as a CasADi function: a loop over integration steps inside one call.

`fast_period` iterates the induced velocity from step to step and reports any doubt about it; `checked_period` solves
for it anew at every evaluation, with the safe solver, and reports where the model has no answer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, reduce

import casadi as ca

from quadexp.errors import UsageError
from quadexp.physics.blade_element import ADOPTED, PRINTED, CrossTerms, aerodynamic_wrench, rotor_flow
from quadexp.physics.expression import Expression
from quadexp.physics.induced_velocity import Balance, balance, newton, solution_function, starting_point
from quadexp.physics.integrator import euler_step, rk4_step
from quadexp.physics.rigid_body import body_features, state_derivative
from quadexp.physics.rotor import C_LA, THETA
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.world.period import unit_attitude

METHODS = {"euler": euler_step, "rk4": rk4_step}
FIRST_ITERATIONS = 6  # Newton steps at the beginning of a period
ITERATIONS = 2  # Newton steps at every later evaluation
LARGEST_CHANGE = 1e-5  # m/s, of the last Newton step; the error left is of the order of its square

INPUTS = ("x", "w", "w_command", "parameters", "step", "blend")
OUTPUTS = ("x_next", "w_next", "induced_velocity", "specific_force")


@dataclass(frozen=True)
class PeriodModel:
    """What decides the structure of the functions. method: "euler" or "rk4".

    Raises UsageError for another method.
    """

    vehicle: Vehicle
    method: str
    rotor_local_velocity: bool
    printed_coefficients: bool

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise UsageError(f"plant.method={self.method}: must be one of {', '.join(METHODS)}")

    @property
    def terms(self) -> CrossTerms:
        return PRINTED if self.printed_coefficients else ADOPTED

    @property
    def n_parameters(self) -> int:
        return len(THETA) + self.vehicle.n_rotors + 1

    def split(self, parameters: Expression) -> tuple[Expression, Expression, Expression]:
        """theta (5,), lift_scale (n,), mass with payload (kg) of a parameter vector."""
        return parameters[: len(THETA)], parameters[len(THETA) : -1], parameters[-1]

    def equation(self, x: Expression, w: Expression, parameters: Expression) -> Balance:
        """The rotors' thrust balance in the state x (13,) at the speeds w (n,) (rad/s)."""
        theta, lift_scale, _ = self.split(parameters)
        velocity, rate = self._motion(x)
        flow = rotor_flow(self.vehicle, velocity, rate)
        return balance(
            self.vehicle.rotor_geometry, theta[C_LA] * lift_scale, w, flow.in_plane_squared, flow.axial, self.terms
        )

    def specific_force_and_torque(
        self, x: Expression, w: Expression, induced: Expression, parameters: Expression
    ) -> tuple[Expression, Expression]:
        """F / M (3,) (m/s^2) and Gamma (3,) (N m), body frame."""
        theta, lift_scale, mass = self.split(parameters)
        velocity, rate = self._motion(x)
        force, torque = aerodynamic_wrench(
            self.vehicle, theta, velocity, w, induced, rate=rate, lift_scale=lift_scale, terms=self.terms
        )
        return force / mass, torque

    def derivative(self, x: Expression, w: Expression, induced: Expression, parameters: Expression) -> Expression:
        """x' (13,)."""
        correction = ca.vertcat(*self.specific_force_and_torque(x, w, induced, parameters))
        return state_derivative(x, type(x)(self.vehicle.n_rotors, 1), self.vehicle, correction)

    def integrate(self, slope: Callable[[Expression], Expression], x: Expression, step: Expression) -> Expression:
        """The next state, its quaternion brought back to unit length."""
        return unit_attitude(METHODS[self.method](slope, x, step))

    def _motion(self, x: Expression) -> tuple[Expression, Expression | None]:
        features = body_features(x, x[:0])
        return features[:3], features[3:6] if self.rotor_local_velocity else None


@cache
def fast_period(model: PeriodModel, steps: int) -> ca.Function:
    """INPUTS -> OUTPUTS, doubt; doubt is not zero where the induced velocity may not be the model's solution.

    x (13,), w (n,) rotor speeds (rad/s), w_command (n,), parameters (5 + n + 1,), step (s), blend: share of the way to
    w_command that the rotor speeds go in one step.
    """
    x, w, w_command, parameters, h, blend = _symbols(model, ca.SX)
    last, doubt = ca.SX.sym("V_I", model.vehicle.n_rotors), ca.SX.sym("doubt")
    w_now, doubts, induced = w + blend * (w_command - w), [doubt], last

    def slope(state: Expression) -> Expression:
        nonlocal induced
        equation = model.equation(state, w_now, parameters)
        before = newton(equation, induced, ITERATIONS - 1)
        induced = newton(equation, before, 1)
        doubts.append(_doubt(equation, before, induced))
        return model.derivative(state, w_now, induced, parameters)

    x_next = model.integrate(slope, x, h)
    carry = ca.vertcat(x, last, w, doubt)
    carry_next = ca.cse(ca.vertcat(x_next, induced, w_now, ca.mmax(ca.vertcat(*doubts))))
    one = ca.Function("blade_element_step", [carry, w_command, parameters, h, blend], [carry_next])

    equation = model.equation(x, w_now, parameters)
    begin = ca.Function(
        "begin",
        [x, w, w_command, parameters, blend],
        [ca.cse(ca.vertcat(x, newton(equation, starting_point(equation), FIRST_ITERATIONS), w, 0))],
    )
    equation = model.equation(x, w, parameters)
    at_end = newton(equation, last, ITERATIONS)
    reading, _ = model.specific_force_and_torque(x, w, at_end, parameters)
    end = ca.Function("end", [carry, parameters], ca.cse([x, w, at_end, reading, doubt]))

    x, w, w_command, parameters, h, blend = arguments = _symbols(model, ca.MX)
    constant = (ca.repmat(value, 1, steps) for value in (w_command, parameters, h, blend))
    final = one.fold(steps)(begin(x, w, w_command, parameters, blend), *constant)
    return ca.Function("blade_element_period", arguments, end(final, parameters), INPUTS, [*OUTPUTS, "doubt"])


@cache
def checked_period(model: PeriodModel, steps: int) -> ca.Function:
    """INPUTS as in `fast_period` -> OUTPUTS, status (n, steps) as `Defined`, flow (3, n steps): V_h, V_z, w there."""
    n = model.vehicle.n_rotors
    x, w, w_command, parameters, h, blend = _symbols(model, ca.MX)
    solution = solution_function(model.vehicle.rotor_geometry, model.terms).map(n)
    w_now, statuses, flows = w + blend * (w_command - w), [], []

    def solve(state: Expression, speeds: Expression) -> Expression:
        theta, lift_scale, _ = model.split(parameters)
        equation = model.equation(state, speeds, parameters)
        squared, axial = (_row(value, n) for value in (equation.in_plane_squared, equation.axial))
        induced, status = solution((theta[C_LA] * lift_scale).T, speeds.T, squared, axial)
        statuses.append(status.T)
        flows.append(ca.vertcat(ca.sqrt(squared), axial, speeds.T))
        return induced.T

    x_next = model.integrate(lambda s: model.derivative(s, w_now, solve(s, w_now), parameters), x, h)
    worst = reduce(ca.fmax, statuses)
    carry = ca.vertcat(x, w)
    one = ca.Function(
        "checked_step",
        [x, w, w_command, parameters, h, blend],
        [ca.vertcat(x_next, w_now), worst, flows[0]],
    )
    one = ca.Function(
        "checked_step",
        [carry_in := ca.MX.sym("carry", carry.shape[0]), w_command, parameters, h, blend],
        one(carry_in[:N_STATE], carry_in[N_STATE:], w_command, parameters, h, blend),
    )
    induced = solve(x, w)
    reading, _ = model.specific_force_and_torque(x, w, induced, parameters)
    end = ca.Function("end", [x, w, parameters], [x, w, induced, reading])

    constant = (ca.repmat(value, 1, steps) for value in (w_command, parameters, h, blend))
    carries, status, flow = one.mapaccum(steps)(ca.vertcat(x, w), *constant)
    final = carries[:, -1]
    return ca.Function(
        "blade_element_checked",
        [x, w, w_command, parameters, h, blend],
        [*end(final[:N_STATE], final[N_STATE:], parameters), status, flow],
        INPUTS,
        [*OUTPUTS, "status", "flow"],
    )


def _symbols(model: PeriodModel, kind: type[Expression]) -> list[Expression]:
    n = model.vehicle.n_rotors
    sizes = (N_STATE, n, n, model.n_parameters, 1, 1)
    return [kind.sym(name, size) for name, size in zip(INPUTS, sizes, strict=True)]


def _row(value: Expression, n: int) -> Expression:
    """(1, n) of a scalar or of (n,)."""
    return ca.repmat(value, 1, n) if value.is_scalar() else value.T


def _doubt(equation: Balance, before: Expression, induced: Expression) -> Expression:
    """1 where the last Newton step was too long to end, or the root lies below V_z with V_z > 2.83 V_h; else 0."""
    unsettled = ca.fabs(induced - before) > LARGEST_CHANGE
    steep = equation.axial**2 > 8 * equation.in_plane_squared
    return ca.mmax(ca.logic_or(unsettled, ca.logic_and(steep, induced < equation.axial)))
