"""The model predictive controller behind the controller seam."""

from __future__ import annotations

import numpy as np

from quadexp.control.base import Controller, Measurement, Window
from quadexp.control.mpc import ModelPredictiveController, StepRecord
from quadexp.residual.base import Residual


class PredictiveController:
    """A ModelPredictiveController as a Controller (see control.base)."""

    reference_period = 0.0

    def __init__(self, mpc: ModelPredictiveController) -> None:
        self.mpc = mpc
        self.vehicle, self.settings, self.backend = mpc.vehicle, mpc.settings, mpc.backend
        self.control_period, self.node_times = mpc.settings.control_period, mpc.node_times
        self.name, self.source = mpc.residual.name, mpc.residual.source

    @property
    def residual(self) -> Residual | None:
        """What references contain of the air: the model where it feeds forward."""
        known = self.mpc.residual
        return known if self.settings.feedforward and not known.is_zero else None

    def forget(self) -> None:
        """See Controller.forget; nothing is learned in flight."""

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        self.mpc.reset(x, window.state, window.input)

    def step(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, StepRecord]:
        """See Controller.step."""
        return self.mpc.command(measurement.state, window.state, window.input)

    def log(self) -> dict[str, float]:
        """See Controller.log; an MPC's record says all."""
        return {}


def as_controller(controller: Controller | ModelPredictiveController) -> Controller:
    """The controller, an MPC put behind the seam."""
    return PredictiveController(controller) if isinstance(controller, ModelPredictiveController) else controller
