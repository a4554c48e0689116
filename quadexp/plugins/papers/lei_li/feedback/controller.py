"""The feedback controller of Lei & Li 2017 as a law in closed form (quadexp.control.law)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.inputs import Inputs
from quadexp.control.law import Law
from quadexp.control.laws.explicit import ExplicitController
from quadexp.errors import UsageError
from quadexp.models.build_context import BuildContext
from quadexp.names import named
from quadexp.parts.settings import REQUIRED, Backend, key, keyed
from quadexp.physics.expression import Expression, split
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import ATTITUDE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.coefficients import THETA
from quadexp.plugins.papers.lei_li.feedback.frames import FRD_FLU
from quadexp.plugins.papers.lei_li.feedback.law import (
    VARIANTS,
    FeedbackSettings,
    Variant,
    hover_rotor_speed,
    law_function,
)
from quadexp.plugins.papers.lei_li.rls import Identification

INNER_TOLERANCE = 1e-10  # rad/s and rad, of the fixed point without delay
RLS = "rls_"  # before the names of what identification knows


@keyed
class Feedback(FeedbackSettings, Law):
    """Compensated feedback. variant: what is compensated, and from where.

    Columns: desired tilt and its error (rad, FRD), active safety limits, coefficients identified in flight."""

    former_kind = "feedback"
    symbols = ca.MX
    nodes = (0.0,)

    variant: Literal["rls", "static", "literal", "nocomp_statid", "oracle", "oracle_impl", "rls_noH", "static_H"] = key(
        REQUIRED, "what is compensated, and the source of the coefficients; see docs/lei_li.md"
    )
    backend: Backend = "auto"
    rls: Identification = key(REQUIRED, "recursive least squares in flight")

    @property
    def compensates(self) -> Variant:
        """What, and with which coefficients."""
        return VARIANTS[self.variant]

    @property
    def identifies(self) -> bool:
        """Whether it identifies coefficients in flight."""
        return self.compensates.parameters == "identified"

    @property
    def knows_plant(self) -> bool:
        """See ControllerPart."""
        return self.compensates.parameters == "true"

    @property
    def logged(self) -> tuple[str, ...]:  # type: ignore[override]  # the same for all there, of a variant here
        """See Law."""
        identified = (*THETA, "clips", "reopened") if self.identifies else ()
        return ("phi_d", "theta_d", "error_eta", "cone", "floored", "limited", *identified)

    def remembers(self, inputs: Inputs) -> Mapping[str, int]:
        """See Law: values of the previous sample; what identification knows."""
        sizes = {"rotor_speed": inputs.vehicle.n_rotors, "eta_d": 3, "observer": 6, "velocity": 3}
        return sizes | {name: values.size for name, values in self._known_first.items()}

    def start(self, vehicle: Vehicle, x: np.ndarray) -> dict[str, np.ndarray]:
        """See Law: hover rotor speeds and R_d = I."""
        velocity = FRD_FLU @ air_velocity(x[ATTITUDE], x[VELOCITY])
        hover = np.full(vehicle.n_rotors, hover_rotor_speed(vehicle))
        return {"rotor_speed": hover, "velocity": velocity} | self._known_first

    @property
    def _known_first(self) -> dict[str, np.ndarray]:
        """What identification knows before the first sample, by its name in the memory."""
        known = self.rls.remembered if self.identifies else {}
        return {RLS + name: values for name, values in known.items()}

    def equations(self, vehicle: Vehicle, inputs: Inputs, memory: Any) -> dict[str, Any]:
        """See Law; (27) to (40). Rotor speeds that are not measured are those that were commanded."""
        read, turning = ca.vertsplit(inputs.fresh)
        measured = ca.logic_and(read, turning)
        speed = ca.if_else(measured, inputs.rotor_speed, memory.rotor_speed)
        results: dict[str, Any] = {}
        theta = ca.DM.zeros(len(THETA))
        if self.identifies:
            velocity = air_velocity(inputs.state[ATTITUDE], inputs.state[VELOCITY])
            sample = {"v": velocity, "w": speed, "y": inputs.specific_force, "read": read}
            known = {name: getattr(memory, RLS + name) for name in self.rls.remembered}
            after = self.rls.after(vehicle, known, sample)
            theta = after["used"]
            results = {RLS + name: value for name, value in after.items()}
            results |= named(THETA, ca.vertsplit(theta))
            results["clips"] = ca.sum1(after["clips"])
            results["reopened"] = after["reopened"]
        elif self.knows_plant:
            theta = inputs.symbol("coefficients", (len(THETA), 1))
        law = law_function(vehicle, self, self.compensates)
        yaw = inputs.heading + ca.vertcat(0, inputs.drift, 0)
        arguments = {"x": inputs.state, "reference": inputs.path[:, :3], "yaw": yaw, "theta": theta}
        arguments["observer_last"] = ca.reshape(memory.observer, 3, 2)
        last = {"rotor_speed": speed, "eta_d": memory.eta_d, "velocity": memory.velocity}
        if self.compensates.delayed:
            result = law.call(arguments | {f"{name}_last": value for name, value in last.items()})
        else:
            result = _fixed_point(law, arguments, last, self.inner_iterations)
        results |= {name: result[name] for name in (*last, "floored", "limited")}
        results["observer"] = ca.vec(result["observer"])
        results |= named(("phi_d", "theta_d"), ca.vertsplit(result["eta_d"][:2]))
        results["error_eta"] = ca.norm_2(result["error"])
        results["cone"] = result["outside"]
        results["command"] = result["thrust"]
        results["held"] = result["floored"] + result["limited"]
        return results

    def controller(self, vehicle: Vehicle, *more: Any, **places: Any) -> ExplicitController:
        """See Law; UsageError for a vehicle without what the equations need."""
        if vehicle.rotor is None or vehicle.thrust_coefficient is None:
            raise UsageError(
                f"vehicle={vehicle.name}: feedback control needs vehicle.rotor and vehicle.thrust_coefficient;"
                " vehicle=lei_li has them"
            )
        return super().controller(vehicle, *more, **places)

    def build(self, context: BuildContext) -> Any:
        """See ControllerPart; UsageError where it is to know coefficients that the plant does not have."""
        places: dict[str, np.ndarray] = {}
        source = "RLS in flight" if self.identifies else "the vehicle's thrust map"
        if self.knows_plant:
            if context.plant is None or not hasattr(context.plant, "coefficients"):
                raise UsageError(
                    f"{self.name}: knows the plant's blade-element coefficients; plant=blade_element has them"
                )
            places = {"coefficients": context.plant.coefficients.parameters()}
            source = "plant equations"
        controller = self.controller(context.vehicle, places=places)
        controller.residual_name = "thrust_map" if self.compensates.parameters == "none" else "blade_element"
        controller.source = source
        return controller


def _fixed_point(law: ca.Function, arguments: dict[str, Any], last: dict[str, Any], iterations: int) -> dict[str, Any]:
    """The results of the law with compensation terms of this sample instead of those of `last`, the previous one."""
    sizes = [value.numel() for value in last.values()]

    def call(stacked: Expression, arguments: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """The values of `last` that are stacked, and the results of the law with them."""
        values = named(last, split(stacked, sizes))
        return values, law.call(arguments | {f"{name}_last": value for name, value in values.items()})

    fixed = {name: ca.MX.sym(name, value.shape) for name, value in arguments.items()}
    before = ca.MX.sym("before", sum(sizes) + 1)
    values, results = call(before[:-1], fixed)
    change = sum(ca.norm_inf(results[name] - values[name]) for name in ("rotor_speed", "eta_d"))
    moves = change > INNER_TOLERANCE
    moved = ca.vertcat(*(results[name] for name in last))
    after = ca.if_else(moves, moved, before[:-1])
    next_at = ca.if_else(before[-1], ca.vertcat(after, moves), before, True)
    once = ca.Function("once", [before, *fixed.values()], [next_at])
    at = ca.vertcat(*last.values(), 1)
    for _ in range(iterations):
        at = once(at, *arguments.values())
    _, results = call(at[:-1], arguments)
    return results
