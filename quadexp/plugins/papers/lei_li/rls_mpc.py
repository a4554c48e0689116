"""An MPC whose blade-element model is identified in flight."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np

from quadexp.compile.memory import NEXT, NOW, Memory, connected, sizes_of
from quadexp.compile.symbolic import ca
from quadexp.control.base import Window
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import ControlStep, InputArrays, call, copy
from quadexp.control.inputs import Circumstances, Inputs, places_of
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.part import PredictivePart
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.part import RESIDUAL
from quadexp.control.wrapped import thrust_at_start
from quadexp.models.build_context import BuildContext
from quadexp.models.residual import Residual
from quadexp.names import named
from quadexp.parts.settings import REQUIRED, key, keyed, part
from quadexp.physics.expression import named_function
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import ATTITUDE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.coefficients import THETA, BladeCoefficients
from quadexp.plugins.papers.lei_li.rls import Identification

# Changes of (C_d0, C_la, C_D) for which the reference is recomputed: each is about 0.05 m/s^2 at 10 m/s.
NOTABLE = np.array([0.004, 0.015, 0.004, 0.004, 0.004])


class IdentifyingController(PredictiveController):
    """See Controller.

    mpc: with a blade-element residual. rls: how its coefficients are identified. reference_period: s, 0 keeps the first
    reference.
    """

    learns = True

    def __init__(self, mpc: ModelPredictiveController, rls: Identification, reference_period: float) -> None:
        super().__init__(mpc)
        self.rls = rls
        self.reference_period = reference_period
        self._believed = mpc.residual
        self._identify = cached_function(mpc.backend, in_flight, rls, mpc.vehicle)
        self.memory = Memory("Identification", sizes_of([self._identify]) | {"sent": mpc.vehicle.n_rotors})
        self._model = Memory("Model", worked={"theta": mpc.parameters})  # which a prediction around it reads too
        self.forget()

    @property
    def theta(self) -> np.ndarray:
        """The coefficients in use, (5,)."""
        return self.memory.of_now["used"]

    @property
    def residual(self) -> Residual | None:
        """The model with the newest coefficients; the same object while no change exceeds NOTABLE."""
        if np.any(np.abs(self.theta - self._believed.theta) > NOTABLE):
            self._believed = replace(self._believed, theta=self.theta.copy())
        if self.settings.feedforward:
            return self._believed
        return None

    def forget(self) -> None:
        """See Controller.forget."""
        self.memory.begin(self.rls.remembered)
        self._believed = self.mpc.residual

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        self.forget()
        self.memory.begin(self.rls.remembered | {"sent": thrust_at_start(window, self.vehicle)})
        self.mpc.set_parameters(self.theta)
        self._model.commit()

    def prepare(self, window: Window) -> None:
        """Does nothing: the coefficients of the next step depend on its measurement."""

    def control_step(self, inputs: InputArrays, state: np.ndarray) -> ControlStep:
        """See control.control_step."""
        step = super().control_step(inputs, state)
        kept = self.memory.of_next
        clips = np.zeros(1)
        identify = connected(self._identify, places_of(inputs, state), {"clips": clips}, self.memory)
        calls = [call(identify), copy(self.mpc.parameters.reshape(-1), kept["used"])]
        calls += step.calls
        calls.append(copy(kept["sent"], step.command))
        logged = (*step.logged, kept["used"], clips, kept["reopened"])
        return step._replace(calls=calls, logged=logged, memory=(*step.memory, self.memory, self._model))

    def log(self) -> dict[str, float]:
        """See Controller.log: the coefficients in use."""
        kept = self.memory.of_now
        counts = {"clips": float(kept["clips"].sum()), "reopened": float(kept["reopened"][0])}
        return named(THETA, kept["used"].tolist()) | counts


@keyed
class RLSMPC(PredictivePart):
    """MPC whose blade-element model is identified in flight.
    reference_period: s between new references from the identified coefficients; 0: never."""

    former_kind = "rls_mpc"
    given = ("blade_element",)
    residual: Literal["blade_element"] = key("blade_element", RESIDUAL)
    reference_period: float = key(
        REQUIRED, "time between new references from the identified coefficients; 0: never", "[0, 3600]", "s"
    )
    rls: Identification = key(REQUIRED, "recursive least squares in flight", tuned=".noise=0.01..1:log")

    def build(self, context: BuildContext) -> Any:
        """See ControllerPart."""
        from quadexp.plugins.papers.lei_li.blade_element import blade_element_residual

        first = part(BladeCoefficients, self.rls)
        residual = blade_element_residual(context.vehicle, first, "RLS in flight")
        mpc = ModelPredictiveController(context.vehicle, residual, part(MPCSettings, self), backend=self.backend)
        return IdentifyingController(mpc, self.rls, self.reference_period)


def in_flight(rls: Identification, vehicle: Vehicle) -> ca.Function:
    """Identification as a call: rotor speeds that are not measured are replaced by the commanded ones."""
    inputs = Inputs(vehicle, Circumstances(0.0), ca.MX)
    known = {name: inputs.symbol(NOW + name, (values.size, 1)) for name, values in rls.remembered.items()}
    read, turning = ca.vertsplit(inputs.fresh)
    sent = inputs.symbol(f"{NOW}sent", (vehicle.n_rotors, 1))
    commanded = ca.sqrt(ca.fmax(sent, 0) / vehicle.static_thrust_coefficient)
    sample = {
        "v": air_velocity(inputs.state[ATTITUDE], inputs.state[VELOCITY]),
        "w": ca.if_else(turning, inputs.rotor_speed, commanded),
        "y": inputs.specific_force,
        "read": read,
    }
    after = rls.after(vehicle, known, sample)
    results = {NEXT + name: value for name, value in after.items()}
    return named_function("identify", inputs.read, results | {"clips": ca.sum1(after["clips"])})
