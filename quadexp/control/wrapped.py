"""A controller around another one: what every compensation is that is not part of the controller's own model.

    observer < adaptive < rate_loop < delay                  the one named first is nearest to the controller

A subclass overrides what it changes; all the rest is the wrapped controller's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.control.base import Controller, Window
from quadexp.control.control_step import InCalls
from quadexp.control.mpc.controller import PredictiveController
from quadexp.models.residual import Residual, no_residual
from quadexp.physics.vehicle import Vehicle


class WrappedController(InCalls):
    """A Controller (see control.base) that passes everything on to `wrapped`, and says by `control_step` what it
    does."""

    def __init__(self, wrapped: Controller) -> None:
        self.wrapped = wrapped
        self.vehicle: Vehicle = wrapped.vehicle
        self.control_period = wrapped.control_period
        self.node_times = wrapped.node_times
        self.reference_period = wrapped.reference_period
        self.backend = wrapped.backend
        self.residual_name = wrapped.residual_name
        self.source = wrapped.source

    @property
    def residual(self) -> Residual | None:
        """See Controller.residual."""
        return self.wrapped.residual

    def forget(self) -> None:
        """See Controller.forget."""
        self.wrapped.forget()

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        self.wrapped.reset(x, window)

    def log(self) -> dict[str, float]:
        """See Controller.log."""
        return self.wrapped.log()


def thrust_at_start(window: Window, vehicle: Vehicle) -> np.ndarray:
    """What the rotors give as a flight begins, (n,) (N): the reference's thrusts within the limits; those of hover
    where the controller asks for no reference."""
    if not len(window.input):
        return np.full(vehicle.n_rotors, vehicle.hover_thrust)
    return np.clip(window.input[0], vehicle.thrust_min, vehicle.thrust_max)


def layers(controller: Any) -> list[WrappedController]:
    """The remedies around a controller, the outermost first."""
    remedies = []
    while isinstance(controller, WrappedController):
        remedies.append(controller)
        controller = controller.wrapped
    return remedies


def innermost(controller: Any) -> Any:
    """The controller inside all remedies; the controller itself where there is none."""
    while isinstance(controller, WrappedController):
        controller = controller.wrapped
    return controller


def air_of(controller: Any) -> Residual:
    """The controller's model of the air, none where it has none."""
    predicts = isinstance(controller, PredictiveController)
    known = controller.mpc.residual if predicts else getattr(controller, "air", controller.residual)
    return no_residual(controller.vehicle) if known is None else known


def parameters_of(controller: Any) -> np.ndarray:
    """The parameters of that model, the very array that changes in flight where they do."""
    if isinstance(controller, PredictiveController):
        return controller.mpc.parameters
    return np.ascontiguousarray(air_of(controller).theta, float)
