"""The MPC as an option of the configuration: its settings, its model of the air, and how it is made."""

from __future__ import annotations

from typing import Any, ClassVar

from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.part import RESIDUAL, ControllerPart
from quadexp.errors import UsageError
from quadexp.models.build_context import BuildContext
from quadexp.parts.settings import REQUIRED, Backend, Setting, key, keyed, part

PARTS = Setting("models that are added to the rigid body in the prediction, and summed", options="model")


@keyed
class PredictivePart(MPCSettings, ControllerPart):
    """What every MPC has, whatever its model of the air."""

    former_kind = "mpc"
    added: ClassVar[tuple[str, ...]] = ()
    backend: Backend = "auto"

    def build(self, context: BuildContext) -> Any:
        """See ControllerPart."""
        from quadexp.control.mpc.controller import PredictiveController
        from quadexp.control.mpc.mpc import ModelPredictiveController

        residual = self.model(context)
        if any(compensation.scales_air(context) for compensation in context.remedies):
            from quadexp.models.residual import scaled_residual

            residual = scaled_residual(residual)
        disturbed = any(compensation.believes for compensation in context.remedies)
        settings = part(MPCSettings, self)
        for compensation in context.remedies:
            settings = compensation.suited(settings)
        return PredictiveController(
            ModelPredictiveController(context.vehicle, residual, settings, backend=self.backend, disturbed=disturbed)
        )

    def model(self, context: BuildContext) -> Any:
        """Its model of the air, a Residual."""
        return context.residual(*self.kinds)


@keyed
class MPC(PredictivePart):
    """Model predictive control (Torrente et al. 2021). residual: its model of the air."""

    added = ("fallback",)
    residual: str = key(REQUIRED, RESIDUAL)
    fallback: bool = key(
        False, "weigh the learned model by its variance: outside its data it becomes drag that is fitted to it"
    )

    def model(self, context: BuildContext) -> Any:
        """See PredictivePart."""
        model = super().model(context)
        if not self.fallback:
            return model
        if not self.learned:
            raise UsageError(f"controller.fallback: residual={self.residual} is not learned from flights")
        return context.checkpoint(0).weighed(context.vehicle, model)


@keyed
class SumMPC(PredictivePart):
    """MPC with a sum of models; `models` holds one checkpoint folder for each of them."""

    former_kind = "sum_mpc"
    residual: tuple[str, ...] = key(REQUIRED, PARTS)
