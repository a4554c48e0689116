"""One setting as an option: delay=auto, or remedies=auto."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from quadexp.control.laws.explicit import ExplicitController
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.part import Compensation
from quadexp.errors import UsageError
from quadexp.models.build_context import BuildContext
from quadexp.plugins.auto.around_law import AutoLaw
from quadexp.plugins.auto.around_mpc import AutoMPC
from quadexp.plugins.auto.auto import Auto
from quadexp.plugins.auto.decide import grids
from quadexp.plugins.auto.sources import speeds_tell


@dataclass(frozen=True, kw_only=True)
class AutoPart(Compensation):
    """Delays, errors of the model and wind, estimated in flight; alone around a controller."""

    prefix = "delay."
    believes = True
    alone = True

    def scales_air(self, context: BuildContext) -> bool:
        """See Remedy."""
        return speeds_tell(context.vehicle, context.sensor_spec)

    def suited(self, settings: Any) -> Any:
        """See Remedy. UsageError where it is given what it finds itself, or to plan otherwise than it does."""
        names = "dead_time", "motor_lag", "motor_lead"
        if given := [f"controller.{name}=0" for name in names if getattr(settings, name)]:
            raise UsageError(f"delay={self.name}: finds dead time and lag itself; set {' '.join(given)}")
        if settings.input_hold == "command":
            raise UsageError(f"delay={self.name}: plans otherwise; set controller.input_hold=deviation")
        return grids(replace(settings, input_hold="deviation"))[0]

    def put_around(self, controller: Any, context: BuildContext) -> Auto:
        """See Remedy. UsageError where the controller learns its model itself, or has other remedies around it."""
        others = [remedy.prefix.rstrip(".") for remedy in context.remedies if remedy.prefix != self.prefix]
        here = f"; set {' and '.join(f'{group}=none' for group in others)}"
        around: Any = AutoMPC if type(controller) is PredictiveController else AutoLaw
        if around is AutoLaw and not isinstance(controller, ExplicitController):
            here = ", which this one is not"
        elif not others:
            return around(controller, context.sensor_spec)
        raise UsageError(
            f"delay={self.name}: stands alone around an MPC whose model does not adapt, or a law in closed form{here}"
        )
