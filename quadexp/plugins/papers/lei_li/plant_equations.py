"""Equations of Lei & Li's plant (Lei & Li 2017, equations 1-17), as CasADi functions.

    w_i = sqrt(u_i / k_T,static)                     commanded static thrusts u become rotor speeds
    v'  = R F / M + g,   M = m + payload             F, Gamma: aerodynamics/blade_element.py, V_I of every step
    J w' = Gamma - w x J w

`fast_equations` iterate the induced velocity from step to step and report any doubt about it; `checked_equations` solve
for it anew at every evaluation, with the safe solver, and report where the model has no answer.

Inner states: rotor speeds w (n,) (rad/s), then induced velocities (n,) (m/s), which have no memory: every period begins
with new ones. Parameters: theta (5,), lift_scale (n,), mass with payload (kg), static thrust coefficient of every rotor
(n,) (N s^2), blend: share of the way to the commanded speeds that the rotors go in one step.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, reduce

from quadexp.compile.symbolic import ca
from quadexp.parts.settings import Settings, key
from quadexp.physics.expression import Expression, limited, symbols
from quadexp.physics.rigid_body import body_features, state_derivative
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.blade_element import ADOPTED, PRINTED, CrossTerms, aerodynamic_wrench, rotor_flow
from quadexp.plugins.aerodynamics.coefficients import C_LA, IDLE_SPEED, STANDING, THETA
from quadexp.plugins.aerodynamics.induced_velocity import Balance, balance, newton, solution_function, starting_point
from quadexp.world.integrator import STEP_INPUTS, Equations, integrate

FIRST_ITERATIONS = 6  # Newton steps at the beginning of a period
ITERATIONS = 2  # Newton steps at every later evaluation
ROUGH_ITERATIONS = 4  # Newton steps at the first evaluation of a step, where wind and thrusts jump between steps
LARGEST_CHANGE = 1e-5  # m/s, of the last Newton step; the error left is of the order of its square


@dataclass(frozen=True)
class BladeElementEffects(Settings):
    """What differs from the paper's plant, or the options it has."""

    prefix = "plant."

    printed_coefficients: bool = key(
        False, "use the cross terms of equations (14) and (15) with their misprints, for comparison only"
    )
    rotor_local_velocity: bool = key(
        False, "the air velocity at each rotor includes the body rates: v + w x r in place of v"
    )
    motor_lag: float = key(0.0, "time constant of the rotor speeds; 0: no lag", "[0, 1]", "s")
    rotor_speed_min: float = key(
        IDLE_SPEED,
        "idle speed; with 0 rotors may stop, which the model describes in still air only",
        "[0, 1000]",
        "rad/s",
    )
    rotor_speed_max: float | None = key(None, "largest speed of the rotors; null: no limit", "(0, 1e5]", "rad/s")
    thrust_limits: bool = key(False, "clip commands to the vehicle's thrust limits (the paper does not)")


@dataclass(frozen=True)
class BladeElementModel:
    """What decides the structure of the equations. method: "euler" or "rk4"."""

    vehicle: Vehicle
    method: str
    effects: BladeElementEffects

    @property
    def terms(self) -> CrossTerms:
        return PRINTED if self.effects.printed_coefficients else ADOPTED

    def split(self, parameters: Expression) -> tuple[Expression, Expression, Expression]:
        """theta (5,), lift_scale (n,), mass with payload (kg) of a parameter vector."""
        mass = len(THETA) + self.vehicle.n_rotors
        return parameters[: len(THETA)], parameters[len(THETA) : mass], parameters[mass]

    def commanded(self, u: Expression, parameters: Expression) -> Expression:
        """Rotor speeds that the static thrusts u (n,) (N) ask for, within the limits, and `blend`, (n + 1,)."""
        thrust_coefficient = parameters[-1 - self.vehicle.n_rotors : -1]
        if self.effects.thrust_limits:
            u = limited(u, self.vehicle.thrust_min, self.vehicle.thrust_max)
        w = ca.sqrt(ca.fmax(u, 0) / thrust_coefficient)
        w = ca.fmax(w, max(self.effects.rotor_speed_min, STANDING))
        if self.effects.rotor_speed_max is not None:
            w = ca.fmin(w, self.effects.rotor_speed_max)
        return ca.vertcat(w, parameters[-1])

    def rotor_speed(self, w: Expression, held: Expression) -> Expression:
        """Rotor speeds (n,) (rad/s) after a step that begins with w (n,); held: of `commanded`."""
        return w + held[-1] * (held[:-1] - w)

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

    def _motion(self, x: Expression) -> tuple[Expression, Expression | None]:
        features = body_features(x, x[:0])
        return features[:3], features[3:6] if self.effects.rotor_local_velocity else None

    def static_thrust(self, w: Expression) -> Expression:
        """(n,) (N) at the speeds w (n,) (rad/s)."""
        return self.vehicle.static_thrust_coefficient * w**2

    def symbols(self, kind: type[Expression]) -> list[Expression]:
        """x, w, held, parameters, h."""
        n = self.vehicle.n_rotors
        sizes = {"x": N_STATE, "w": n, "held": n + 1, "parameters": len(THETA) + 2 * n + 2, "h": 1}
        return symbols(kind, **sizes)


@cache
def fast_equations(model: BladeElementModel, rough: bool = False) -> Equations:
    """In doubt where the induced velocity may not be the model's solution. s: x, induced velocity, w, doubt.

    rough: for wind and thrusts that jump from one step to the next, as they do in a world.
    """
    n = model.vehicle.n_rotors
    x, w, held, parameters, h = model.symbols(ca.SX)
    last, doubt, noise = symbols(ca.SX, V_I=n, doubt=1, noise=0)
    w_now = model.rotor_speed(w, held)
    doubts = [doubt]
    induced = last

    def slope(state: Expression) -> Expression:
        nonlocal induced
        equation = model.equation(state, w_now, parameters)
        iterations = ROUGH_ITERATIONS if rough and len(doubts) == 1 else ITERATIONS
        before = newton(equation, induced, iterations - 1)
        induced = newton(equation, before, 1)
        doubts.append(_doubt(equation, before, induced))
        return model.derivative(state, w_now, induced, parameters)

    s = ca.vertcat(x, last, w, doubt)
    x_next = integrate(model.method, slope, x, h)
    s_next = ca.cse(ca.vertcat(x_next, induced, w_now, ca.mmax(ca.vertcat(*doubts))))

    equation = model.equation(x, w_now, parameters)
    first = ca.cse(ca.vertcat(x, newton(equation, starting_point(equation), FIRST_ITERATIONS), w, 0))

    equation = model.equation(x, w, parameters)
    at_end = newton(equation, last, ITERATIONS)
    reading, _ = model.specific_force_and_torque(x, w, at_end, parameters)
    standing = ca.mmax(held[:-1] <= STANDING)
    results = ca.cse([x, ca.vertcat(w, at_end), reading, ca.fmax(doubt, standing)])
    return _equations(
        model,
        step=ca.Function("blade_element_step", [s, held, noise, parameters, h], [s_next]),
        first=ca.Function("begin", [x, w, held, parameters], [first]),
        end=ca.Function("end", [s, held, parameters], results),
        thrust=ca.Function("thrust", [s, held, parameters, h], [model.static_thrust(w_now)]),
    )


@cache
def checked_equations(model: BladeElementModel) -> Equations:
    """Never in doubt. Kept of every step: status (n,) as `Defined`, flow (3, n): V_h, V_z, w there. s: x, w."""
    n = model.vehicle.n_rotors
    s, noise = symbols(ca.MX, s=N_STATE + n, noise=0)
    x = s[:N_STATE]
    w = s[N_STATE:]
    x_begin, w_begin, held, parameters, h = model.symbols(ca.MX)
    solution = solution_function(model.vehicle.rotor_geometry, model.terms).map(n)
    w_now = model.rotor_speed(w, held)
    statuses = []
    flows = []

    def solve(state: Expression, speeds: Expression) -> Expression:
        theta, lift_scale, _ = model.split(parameters)
        equation = model.equation(state, speeds, parameters)
        squared = _row(equation.in_plane_squared, n)
        axial = _row(equation.axial, n)
        induced, status = solution((theta[C_LA] * lift_scale).T, speeds.T, squared, axial)
        statuses.append(status.T)
        flows.append(ca.vertcat(ca.sqrt(squared), axial, speeds.T))
        return induced.T

    x_next = integrate(model.method, lambda x: model.derivative(x, w_now, solve(x, w_now), parameters), x, h)
    worst = reduce(ca.fmax, statuses)
    at_end = solve(x, w)
    reading, _ = model.specific_force_and_torque(x, w, at_end, parameters)

    results = [ca.vertcat(x_next, w_now), worst, flows[0]]
    kept = ["s_next", "status", "flow"]
    first = ca.vertcat(x_begin, w_begin)
    return _equations(
        model,
        step=ca.Function("checked_step", [s, held, noise, parameters, h], results, STEP_INPUTS, kept),
        first=ca.Function("begin", [x_begin, w_begin, held, parameters], [first]),
        end=ca.Function("checked_end", [s, held, parameters], [x, ca.vertcat(w, at_end), reading, ca.MX(1, 1)]),
        thrust=ca.Function("thrust", [s, held, parameters, h], [model.static_thrust(w_now)]),
    )


def _equations(
    model: BladeElementModel, *, step: ca.Function, first: ca.Function, end: ca.Function, thrust: ca.Function
) -> Equations:
    """With what is the same for both. first: (x, w, held, parameters) -> s at the beginning of a period."""
    n = model.vehicle.n_rotors
    x, _, _, parameters, _ = model.symbols(ca.MX)
    inner, u = symbols(ca.MX, inner=2 * n, u=n)
    held = model.commanded(u, parameters)
    begin = ca.Function("begin_period", [x, inner, u, parameters], [first(x, inner[:n], held, parameters), held])
    _, _, _, parameters, _ = model.symbols(ca.SX)
    u = ca.SX.sym("u", n)
    command = ca.Function("command", [u, parameters], [model.commanded(u, parameters)])
    mass = ca.Function("mass", [parameters], [model.split(parameters)[2]])
    return Equations(step, begin, end, command, mass, thrust)


def _row(value: Expression, n: int) -> Expression:
    """(1, n) of a scalar or of (n,)."""
    if value.is_scalar():
        return ca.repmat(value, 1, n)
    return value.T


def _doubt(equation: Balance, before: Expression, induced: Expression) -> Expression:
    """1 where the last Newton step was too long to end, or the root lies below V_z with V_z > 2.83 V_h; else 0."""
    unsettled = abs(induced - before) > LARGEST_CHANGE
    steep = equation.axial**2 > 8 * equation.in_plane_squared
    return ca.mmax(ca.logic_or(unsettled, ca.logic_and(steep, induced < equation.axial)))
