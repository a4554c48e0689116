"""Lei & Li's plant: a rigid body under blade-element rotors and body drag (Lei & Li 2017; plant_equations.py).

Integrated by Euler's method at 1e-4 s, as in the paper, or by RK4. The state is that of physics/state.py; the induced
velocity has no memory, it is only iterated from its last value. The whole control period runs in one compiled call with
two Newton steps at every evaluation. A period in which that is not beyond doubt (not converged, or steep descent, where
the balance of thrusts may have more roots than one) is flown again with the safe solver, which finds the model's
solution wherever there is one and says where there is not: then `advance` raises ModelDomainError.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import ModelDomainError, UsageError
from quadexp.models.build_context import BuildContext
from quadexp.models.residual import Residual, feature_names, symbolic_residual
from quadexp.parts.settings import REQUIRED, key, keyed, part
from quadexp.physics.expression import symbols
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.blade_element import static_coefficients
from quadexp.plugins.aerodynamics.coefficients import C_D0, STANDING, BladeCoefficients, BladeKeys
from quadexp.plugins.aerodynamics.induced_velocity import REASONS, Defined
from quadexp.plugins.papers.lei_li.blade_element import blade_element_correction
from quadexp.plugins.papers.lei_li.plant_equations import (
    BladeElementEffects,
    BladeElementModel,
    checked_equations,
    fast_equations,
)
from quadexp.world.base import PlantPart
from quadexp.world.integrator import Equations, RotorSpeedPlant


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
        self._payload = 0.0
        self._drag_scale = 1.0
        self._lift_scale = np.ones(self.vehicle.n_rotors)
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
