"""Lei & Li's plant: a rigid body under blade-element rotors and body drag (Lei & Li 2017, equations 1-17).

    w_i = sqrt(u_i / k_T,static)                     commanded static thrusts u become rotor speeds
    v'  = R F / M + g,   M = m + payload             F, Gamma: aerodynamics/blade_element.py, V_I of every step
    J w' = Gamma - w x J w

Integrated by Euler's method at 1e-4 s, as in the paper, or by RK4. The state is that of physics/state.py; the induced
velocity has no memory, it is only iterated from its last value. The whole control period runs in one compiled call with
two Newton steps at every evaluation. A period in which that is not beyond doubt (not converged, or steep descent, where
the balance of thrusts may have more roots than one) is flown again with the safe solver, which finds the model's
solution wherever there is one and says where there is not: then `advance` raises ModelDomainError.

`fast_equations` iterate the induced velocity from step to step and report any doubt about it; `checked_equations` solve
for it anew at every evaluation, with the safe solver, and report where the model has no answer.

Inner states: rotor speeds w (n,) (rad/s), then induced velocities (n,) (m/s), which have no memory: every period begins
with new ones. Parameters: theta (5,), lift_scale (n,), mass with payload (kg), static thrust coefficient of every rotor
(n,) (N s^2), blend: share of the way to the commanded speeds that the rotors go in one step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, reduce
from typing import Any, Literal

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import ModelDomainError, UsageError
from quadexp.models.build_context import BuildContext
from quadexp.models.residual import Residual, feature_names, symbolic_residual
from quadexp.parts.settings import REQUIRED, Settings, key, keyed, part
from quadexp.physics.expression import Expression, limited, symbols
from quadexp.physics.rigid_body import body_features, state_derivative
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.blade_element import (
    ADOPTED,
    PRINTED,
    CrossTerms,
    aerodynamic_wrench,
    rotor_flow,
    static_coefficients,
)
from quadexp.plugins.aerodynamics.coefficients import (
    C_D0,
    C_LA,
    IDLE_SPEED,
    STANDING,
    THETA,
    BladeCoefficients,
    BladeKeys,
)
from quadexp.plugins.aerodynamics.induced_velocity import (
    REASONS,
    Balance,
    Defined,
    balance,
    newton,
    solution_function,
    starting_point,
)
from quadexp.plugins.papers.lei_li.blade_element import blade_element_correction
from quadexp.world.base import PlantPart
from quadexp.world.integrator import STEP_INPUTS, Equations, RotorSpeedPlant, integrate

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
class PlantChange:
    """A change in flight, at a time t (s) from its start; None leaves as it is.

    payload: kg. lift_scale: factor on every rotor's C_la, (n,). profile_drag_scale: factor on C_d0.
    """

    t: float
    payload: float | None = None
    lift_scale: tuple[float, ...] | None = None
    profile_drag_scale: float | None = None


_CHANGES = [one.name for one in fields(PlantChange)]


@keyed
class BladeElement(BladeElementEffects, BladeKeys, PlantPart):
    """Lei & Li's plant. schedule: changes in flight, each {t: s, payload: kg,
    lift_scale: [one factor a rotor], profile_drag_scale: factor}, all but t optional."""

    former_kind = "blade_element"
    former_keys = {"payload": 0.0}

    method: Literal["euler", "rk4"] = key(
        REQUIRED, "explicit Euler as in Lei & Li 2017, or Runge-Kutta of fourth order"
    )
    schedule: tuple[Any, ...] = key(
        (), "changes in flight, each {t: s, payload: kg, lift_scale: [a factor per rotor], profile_drag_scale: factor}"
    )

    def check_together(self) -> None:
        for change in self.schedule:
            unknown = sorted({*change} - {*_CHANGES}) if isinstance(change, Mapping) else [str(change)]
            if unknown or "t" not in change:
                fault = f"unknown {unknown[0]!r}" if unknown else "no t"
                raise UsageError(f"plant.schedule: {fault}; each change is {{t: s, {', '.join(_CHANGES[1:])}}}")

    def build(self, context: BuildContext) -> BladeElementPlant:
        """UsageError where the vehicle has no rotors of known shape."""
        if context.vehicle.rotor is None:
            raise UsageError(
                f"plant={self.name}: vehicle={context.vehicle.name} has no vehicle.rotor (its rotors' shape);"
                " vehicle=lei_li has"
            )
        changes = []
        for change in self.schedule:
            values: dict[str, Any] = {}
            for k, v in change.items():
                values[k] = tuple(v) if isinstance(v, list) else v
            changes.append(PlantChange(**values))
        return BladeElementPlant(
            context.vehicle,
            part(BladeCoefficients, self),
            part(BladeElementEffects, self),
            step=self.step,
            method=self.method,
            schedule=changes,
            backend=self.backend,
        )


class BladeElementPlant(RotorSpeedPlant):
    """The blade-element simulation as a Plant; `reset` begins a flight.

    vehicle: with rotor and thrust_coefficient. coefficients: true ones. step: largest integration step (s); a control
    period is divided evenly. method: "euler" or "rk4". schedule: changes in flight, taking effect from the first period
    that begins at or after their time. After `advance`: rotor_speed (n,) (rad/s) and induced_velocity (n,) (m/s) at the
    last instant. Raises UsageError where the vehicle has no rotor geometry, or an option is out of range.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        coefficients: BladeCoefficients,
        effects: BladeElementEffects | None = None,
        *,
        step: float = 1e-4,
        method: str = "euler",
        schedule: Sequence[PlantChange] = (),
        backend: str = "auto",
    ) -> None:
        _ = vehicle.rotor_geometry, vehicle.static_thrust_coefficient  # UsageError where the vehicle has none
        self.coefficients = coefficients
        self.effects = effects or BladeElementEffects()
        self.schedule = tuple(sorted(schedule, key=lambda change: change.t))
        for change in self.schedule:
            if change.lift_scale is not None and len(change.lift_scale) != vehicle.n_rotors:
                raise UsageError(f"plant.schedule: lift_scale needs {vehicle.n_rotors} factors, one for every rotor")
        structure = replace(self.effects, motor_lag=0.0)  # which is a parameter
        self._model = BladeElementModel(vehicle, method, structure)
        super().__init__(vehicle, fast_equations(self._model), step=step, backend=backend)

    def reset(self) -> None:
        """Begin a flight: time zero, rotors at the speed of hover, nothing changed yet."""
        self._pending = list(self.schedule)
        self._payload, self._drag_scale, self._lift_scale = 0.0, 1.0, np.ones(self.vehicle.n_rotors)
        super().reset()
        self._apply_changes()

    def initial(self, thrust: np.ndarray) -> np.ndarray:
        highest = self.effects.rotor_speed_max or math.inf
        speed = np.sqrt(thrust / self.vehicle.static_thrust_coefficient)
        speed = np.clip(speed, max(self.effects.rotor_speed_min, STANDING), highest)
        inflow = static_coefficients(self.vehicle.rotor_geometry, self.coefficients).inflow
        return np.concatenate([speed, speed * inflow])

    @property
    def inner_columns(self) -> tuple[str, ...]:
        induced = (f"induced_velocity_{rotor}" for rotor in range(self.vehicle.n_rotors))
        return (*super().inner_columns, *induced)

    @property
    def induced_velocity(self) -> np.ndarray:
        """(n,), m/s."""
        return self.inner[self.vehicle.n_rotors :]

    def parameters(self, step: float) -> np.ndarray:
        """Changes that are due take effect."""
        self._apply_changes()
        lag = self.effects.motor_lag
        n = self.vehicle.n_rotors
        thrust_coefficient = np.full(n, self.vehicle.static_thrust_coefficient)
        blend = 1.0 - math.exp(-step / lag) if lag > 0 else 1.0
        return np.concatenate([self._air_parameters(), thrust_coefficient, [blend]])

    def residual(self) -> Residual:
        """As things stand now; motor lag and the upper limits are left out."""
        n = self.vehicle.n_rotors
        z, parameters = symbols(ca.SX, z=len(feature_names(n)), theta=len(self._air_parameters()))
        theta, lift_scale, mass = self._model.split(parameters)
        y, dy_dz = blade_element_correction(
            self.vehicle,
            z,
            theta,
            lift_scale=lift_scale,
            payload=mass - self.vehicle.mass,
            rotor_local_velocity=self.effects.rotor_local_velocity,
            terms=self._model.terms,
            rotor_speed_min=self.effects.rotor_speed_min,
        )
        values = self._air_parameters()
        return symbolic_residual("plant", y, z, parameters, values, source="plant equations", slope=dy_dz)

    def _air_parameters(self) -> np.ndarray:
        """theta (5,), lift_scale (n,), mass with payload: what holds now."""
        theta = self.coefficients.parameters()
        theta[C_D0] *= self._drag_scale
        return np.concatenate([theta, self._lift_scale, [self.vehicle.mass + self._payload]])

    def _apply_changes(self) -> None:
        while self._pending and self._pending[0].t <= self.time + 1e-9:
            change = self._pending.pop(0)
            if change.payload is not None:
                self._payload = change.payload
            if change.lift_scale is not None:
                self._lift_scale = np.array(change.lift_scale, float)
            if change.profile_drag_scale is not None:
                self._drag_scale = change.profile_drag_scale
        self.next_change = self._pending[0].t if self._pending else math.inf

    @property
    def rough_equations(self) -> Equations:
        return fast_equations(self._model, rough=True)

    @property
    def safe_equations(self) -> Equations:
        return checked_equations(self._model)

    def check_safe(self, flown: dict[str, np.ndarray], step: float) -> None:
        status = flown["status"]
        bad = np.argwhere(status.T != Defined.OK)
        if len(bad):
            k, rotor = bad[0]
            flow = flown["flow"][:, k * self.vehicle.n_rotors + rotor]
            raise ModelDomainError(
                f"blade-element model, rotor {rotor} at t={self.time + k * step:.4f} s: "
                f"{REASONS[Defined(int(status[rotor, k]))]} (V_h={flow[0]:.3g} m/s,"
                f" V_z={flow[1]:.3g} m/s, w={flow[2]:.4g} rad/s)"
            )


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
        w = ca.fmax(ca.sqrt(ca.fmax(u, 0) / thrust_coefficient), max(self.effects.rotor_speed_min, STANDING))
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


@cache
def fast_equations(model: BladeElementModel, rough: bool = False) -> Equations:
    """In doubt where the induced velocity may not be the model's solution. s: x, induced velocity, w, doubt.

    rough: for wind and thrusts that jump from one step to the next, as they do in a world.
    """
    n = model.vehicle.n_rotors
    x, w, held, parameters, h = _symbols(model, ca.SX)
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

    x_next = integrate(model.method, slope, x, h)
    s = ca.vertcat(x, last, w, doubt)
    s_next = ca.cse(ca.vertcat(x_next, induced, w_now, ca.mmax(ca.vertcat(*doubts))))

    equation = model.equation(x, w_now, parameters)
    first = ca.cse(ca.vertcat(x, newton(equation, starting_point(equation), FIRST_ITERATIONS), w, 0))

    equation = model.equation(x, w, parameters)
    at_end = newton(equation, last, ITERATIONS)
    reading, _ = model.specific_force_and_torque(x, w, at_end, parameters)
    standing = ca.mmax(held[:-1] <= STANDING)
    results = ca.cse([x, ca.vertcat(w, at_end), reading, ca.fmax(doubt, standing)])
    return Equations(
        ca.Function("blade_element_step", [s, held, noise, parameters, h], [s_next]),
        _begin(model, ca.Function("begin", [x, w, held, parameters], [first])),
        ca.Function("end", [s, held, parameters], results),
        *_for_effects(model),
        _static_thrust(model, [s, held, parameters, h], w_now),
    )


@cache
def checked_equations(model: BladeElementModel) -> Equations:
    """Never in doubt. Kept of every step: status (n,) as `Defined`, flow (3, n): V_h, V_z, w there. s: x, w."""
    n = model.vehicle.n_rotors
    s, noise = symbols(ca.MX, s=N_STATE + n, noise=0)
    x = s[:N_STATE]
    w = s[N_STATE:]
    _, _, held, parameters, h = _symbols(model, ca.MX)
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
    induced = solve(x, w)
    reading, _ = model.specific_force_and_torque(x, w, induced, parameters)

    results = [ca.vertcat(x_next, w_now), worst, flows[0]]
    kept = ["s_next", "status", "flow"]
    return Equations(
        ca.Function("checked_step", [s, held, noise, parameters, h], results, STEP_INPUTS, kept),
        _begin(model, lambda x, w, held, parameters: ca.vertcat(x, w)),
        ca.Function("checked_end", [s, held, parameters], [x, ca.vertcat(w, induced), reading, ca.MX(1, 1)]),
        *_for_effects(model),
        _static_thrust(model, [s, held, parameters, h], w_now),
    )


def _begin(model: BladeElementModel, first: Callable[..., ca.MX]) -> ca.Function:
    """Equations.begin. first: (x, w, held, parameters) -> s."""
    n = model.vehicle.n_rotors
    x, _, _, parameters, _ = _symbols(model, ca.MX)
    inner, u = symbols(ca.MX, inner=2 * n, u=n)
    held = model.commanded(u, parameters)
    return ca.Function("begin_period", [x, inner, u, parameters], [first(x, inner[:n], held, parameters), held])


def _for_effects(model: BladeElementModel) -> tuple[ca.Function, ca.Function]:
    """Equations.command and Equations.mass."""
    _, _, _, parameters, _ = _symbols(model, ca.SX)
    u = ca.SX.sym("u", model.vehicle.n_rotors)
    return (
        ca.Function("command", [u, parameters], [model.commanded(u, parameters)]),
        ca.Function("mass", [parameters], [model.split(parameters)[2]]),
    )


def _static_thrust(model: BladeElementModel, arguments: list[Expression], w: Expression) -> ca.Function:
    """Equations.thrust."""
    return ca.Function("thrust", arguments, [model.vehicle.static_thrust_coefficient * w**2])


def _symbols(model: BladeElementModel, kind: type[Expression]) -> list[Expression]:
    """x, w, held, parameters, h."""
    n = model.vehicle.n_rotors
    sizes = {"x": N_STATE, "w": n, "held": n + 1, "parameters": len(THETA) + 2 * n + 2, "h": 1}
    return symbols(kind, **sizes)


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
