"""The MPC as an option of the configuration: its settings, its model of the air, and how it is made."""

from __future__ import annotations

from typing import Any, ClassVar

from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.part import RESIDUAL, ControllerPart
from quadexp.errors import UsageError
from quadexp.parts.part import Given
from quadexp.parts.settings import REQUIRED, Backend, Setting, key, keyed, part

PARTS = Setting("models that are added to the rigid body in the prediction, and summed", options="model")


@keyed
class PredictivePart(MPCSettings, ControllerPart):
    """What every MPC has, whatever its model of the air."""

    former_kind = "mpc"
    added: ClassVar[tuple[str, ...]] = ()
    backend: Backend = "auto"

    def build(self, given: Given) -> Any:
        """See ControllerPart."""
        from quadexp.control.mpc.controller import PredictiveController
        from quadexp.control.mpc.mpc import ModelPredictiveController

        residual = self.model(given)
        if any(one.scales_air(given) for one in given.remedies):
            from quadexp.models.residual import scaled_residual

            residual = scaled_residual(residual)
        told = any(one.believes for one in given.remedies)
        settings = part(MPCSettings, self)
        for one in given.remedies:
            settings = one.suited(settings)
        return PredictiveController(
            ModelPredictiveController(given.vehicle, residual, settings, backend=self.backend, disturbed=told)
        )

    def model(self, given: Given) -> Any:
        """Its model of the air, a Residual."""
        return given.residual(*self.kinds)


@keyed
class MPC(PredictivePart):
    """Model predictive control (Torrente et al. 2021). residual: its model of the air."""

    added = ("fallback",)
    residual: str = key(REQUIRED, RESIDUAL)
    fallback: bool = key(False, "weigh a Gaussian process by its variance: outside its data it is drag fitted to it")

    def model(self, given: Given) -> Any:
        """See PredictivePart."""
        model = super().model(given)
        if not self.fallback:
            return model
        if not self.learned:
            raise UsageError(f"controller.fallback: residual={self.residual} has no data; gaussian_process has")
        return given.checkpoint(0).weighed(given.vehicle, model)


@keyed
class SumMPC(PredictivePart):
    """MPC with a sum of models; `models` holds one checkpoint folder for each of them."""

    former_kind = "sum_mpc"
    residual: tuple[str, ...] = key(REQUIRED, PARTS)
