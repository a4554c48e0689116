"""Model predictive control with a model of the air that is learned in flight.

`AdaptingController`: before every step one compiled function (quadexp.plugins.remedies.online) takes the last
accelerometer sample into the weights of the last of the summed residuals. `IdentifyingController`: recursive least
squares identify the coefficients of the blade-element residual. Both are runtime parameters of the step, so nothing
is compiled again. The reference's attitudes and thrusts depend on them too; they are recomputed with the newest every
reference_period, which is a slower task.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from quadexp.compile.backend import BufferedFunction, realise
from quadexp.control.base import Window
from quadexp.control.control_step import ControlStep, InputArrays, copy, python
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.part import PredictivePart
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.wrapped import thrust_at_start
from quadexp.errors import UsageError
from quadexp.models.adapting import Adapting
from quadexp.models.build_context import BuildContext
from quadexp.models.residual import Residual, sum_residual
from quadexp.parts.settings import REQUIRED, Settings, key, keyed, part
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.remedies.online import Law, prior_belief, update_function
from quadexp.plugins.remedies.sent_commands import DeliveredThrust


@dataclass(frozen=True)
class AdaptKeys(Settings):
    """How weights adapt in flight; see quadexp/plugins/remedies/online.py."""

    prefix = "controller.adapt."

    law: Literal["bayes", "rls", "composite"] = key(
        "bayes", "bayes: Kalman filter, pulled to the prior; rls: with forgetting; composite: bayes with tracking error"
    )
    memory: float = key(
        10.0, "time constant of forgetting; for rls of the forgetting factor exp(-dt / memory)", "(0, 1e9]", "s"
    )
    noise: float = key(0.1, "standard deviation of a sample of the residual acceleration", "(0, 100]", "m/s^2")
    deviation: float = key(
        0.8, "prior standard deviation of the acceleration that the weights can add, roughly", "(0, 100]", "m/s^2"
    )
    start: Literal["model", "zero"] = key(
        "model", "first weights, to which they return without data: those of the checkpoint, or zero"
    )
    fitc: bool = key(
        False, "of a Gaussian process: count what the inducing points do not know as noise (FITC), not variational"
    )
    every: int = key(1, "every how many periods a sample is used; above 1 for coloured noise", "[1, 1000]", "periods")
    tracking: float = key(
        10.0,
        "of law=composite: weight of the tracking error in the adaptation",
        "[0, 1e6]",
        "s^2 m^-2",
        when="law=composite",
    )
    tracking_rate: float = key(
        1.0,
        "of law=composite: Lambda of the tracking error (v - v_r) + Lambda (p - p_r)",
        "[0, 100]",
        "1/s",
        when="law=composite",
    )


class AdaptingController(PredictiveController):
    """See Controller.

    adapting: the residual that adapts. known: what is summed with it and does not adapt. settings, adapt: of the MPC
    and of the adaptation. reference_period: s, 0 keeps the first reference.
    theta: weights in use, in the adapting residual's parameters. samples: how many have been used.
    """

    learns = True

    def __init__(
        self,
        vehicle: Vehicle,
        known: list[Residual],
        adapting: Adapting,
        settings: MPCSettings,
        adapt: AdaptKeys,
        *,
        reference_period: float = 0.0,
        backend: str = "auto",
    ) -> None:
        model = sum_residual([*known, adapting.residual])
        super().__init__(ModelPredictiveController(vehicle, model, settings, backend=backend))
        self.adapting = adapting
        self.adapt = adapt
        self.reference_period = reference_period
        fixed = sum_residual(known) if known else None
        function = update_function(
            vehicle, adapting, fixed, Law(adapt.law, adapt.fitc), compiled=self.backend == "compiled"
        )
        self._update = BufferedFunction(realise(function, self.backend))
        arguments = self._update.arguments
        results = self._update.results
        period = self.control_period * adapt.every
        arguments["variance"][...] = adapt.noise**2
        arguments["decay"][...] = math.exp(-period / adapt.memory)
        arguments["tracking"][...] = period * adapt.tracking
        arguments["tracking_rate"][...] = adapt.tracking_rate
        if fixed is not None:
            arguments["known_theta"][...] = fixed.theta
        self._belief = arguments["belief"]
        self._new_belief = results["new_belief"]
        self._given = arguments
        self.theta = results["theta"]
        self.innovation = results["innovation"]
        self._all = model.theta.copy()
        self._weights = self._all[len(model.theta) - len(adapting.residual.theta) :]
        self._delivered = DeliveredThrust(vehicle, self.control_period, settings.dead_time, settings.known_lag)
        self._known = model
        self.forget()

    @property
    def residual(self) -> Residual | None:
        """The model with the newest weights; the same object while these are the same."""
        if not np.array_equal(self._known.theta, self._all):
            self._known = replace(self._known, theta=self._all.copy())
        if self.settings.feedforward:
            return self._known
        return None

    def forget(self) -> None:
        """See Controller.forget: back to the prior."""
        self._belief[...] = prior_belief(self.adapting)
        self.theta[...] = self.adapting.residual.theta
        self.innovation[...] = 0.0
        self.samples = 0
        self._wait = 0
        self._take()

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        self.forget()
        self._delivered.reset(thrust_at_start(window, self.vehicle))

    def prepare(self, window: Window) -> None:
        """Does nothing: the weights of the next step depend on its measurement."""

    def control_step(self, inputs: InputArrays, state: np.ndarray) -> ControlStep:
        """See control.control_step; without an accelerometer reading the weights stay."""
        step = super().control_step(inputs, state)
        arguments = self._given
        delivered = self._delivered
        path = arguments["path"]
        places = {"x": state, "f": inputs.specific_force, "u": delivered.thrust}
        learning = [*delivered.before(inputs), *(copy(arguments[name], place) for name, place in places.items())]
        learning += [
            copy(path[:3], inputs.path[0]),
            copy(path[3:], inputs.path[1]),
            python(self._learn, inputs.accelerometer_valid),
        ]
        calls = [*learning, *step.calls, *delivered.after(step.command)]
        memory = (*step.memory, delivered.memory)
        return step._replace(calls=calls, logged=(self.innovation,), memory=memory)

    def log(self) -> dict[str, float]:
        """See Controller.log: what the last sample was away from its prediction."""
        return {f"innovation_{axis}": float(value) for axis, value in zip("xyz", self.innovation, strict=True)}

    def _learn(self) -> None:
        """One update, each `every` samples."""
        self._wait -= 1
        if self._wait >= 0:
            return
        self._wait = self.adapt.every - 1
        self._update()
        self._belief[...] = self._new_belief
        self.samples += 1
        self._take()

    def _take(self) -> None:
        self._weights[...] = self.theta
        self.mpc.set_parameters(self._all)


@keyed
class OnlineMPC(PredictivePart):
    """MPC whose model adapts in flight.

    residual: summed models, of which the last one adapts. models: one folder for each that comes from a checkpoint.
    """

    former_kind = "online_mpc"
    given = ("terms",)
    residual: tuple[str, ...] = key(
        REQUIRED, "summed models; the weights of the last one adapt", options="model", also=("terms",)
    )
    reference_period: float = key(1.0, "time between new references from the adapted model; 0: never", "[0, 3600]", "s")
    adapt: AdaptKeys = key(REQUIRED, "how the weights adapt", tuned=".memory=0.1..100:log .noise=0.03..3:log")

    def check_together(self) -> None:
        super().check_together()
        if "terms" in self.residual[:-1]:
            raise UsageError(
                "controller.residual: terms have no fitted values, so they can only be the last, adapting one"
            )

    def build(self, context: BuildContext) -> Any:
        """See ControllerPart."""
        from quadexp.plugins.aerodynamics.terms import adapting_terms
        from quadexp.plugins.remedies.online import from_zero

        *others, last = self.residual
        if self.adapt.fitc and last != "gaussian_process":
            raise UsageError(f"controller.adapt.fitc: {last} has no inducing points, a Gaussian process has")
        if last != "terms":
            residual = context.residuals(self.residual)[-1]
            adapting = context.checkpoint(-1).adapting(context.vehicle, residual, self.adapt.deviation)
        else:
            adapting = adapting_terms(context.vehicle, self.adapt.deviation)
        if self.adapt.start == "zero":
            adapting = from_zero(adapting)
        return AdaptingController(
            context.vehicle,
            context.residuals(others),
            adapting,
            part(MPCSettings, self),
            self.adapt,
            reference_period=self.reference_period,
            backend=self.backend,
        )
