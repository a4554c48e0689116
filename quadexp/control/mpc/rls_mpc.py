"""Model predictive control with a model of the air whose coefficients are identified in flight.

The coefficients of the blade-element residual are runtime parameters of the control step: recursive least squares
updates them before every step, and nothing is compiled again. The attitudes and thrusts of the reference depend on them
too; they are recomputed with the newest coefficients every reference_period, which is a slower task.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from quadexp.control.base import Window
from quadexp.control.feedback.controller import IdentifiedCoefficients
from quadexp.control.instant import Instant, Told, copy, python
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.part import PredictivePart
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.part import RESIDUAL
from quadexp.control.wrapped import thrust_at_start
from quadexp.models.residual import Residual
from quadexp.models.rls import Identification
from quadexp.parts.part import Given
from quadexp.parts.settings import REQUIRED, key, part

# Changes of (C_d0, C_la, C_D) for which the reference is recomputed: each is about 0.05 m/s^2 at 10 m/s.
NOTABLE = np.array([0.004, 0.015, 0.004, 0.004, 0.004])


class IdentifyingController(PredictiveController):
    """See Controller.

    mpc: with a blade-element residual. identified: its coefficients. reference_period: s, 0 keeps the first reference.
    """

    def __init__(
        self, mpc: ModelPredictiveController, identified: IdentifiedCoefficients, reference_period: float
    ) -> None:
        super().__init__(mpc)
        self.identified, self.reference_period = identified, reference_period
        self._believed, self._commanded = mpc.residual, np.zeros(mpc.vehicle.n_rotors)

    @property
    def residual(self) -> Residual | None:
        """The model with the newest coefficients; the same object while no change exceeds NOTABLE."""
        theta = self.identified.theta
        if np.any(np.abs(theta - self._believed.theta) > NOTABLE):
            self._believed = replace(self._believed, theta=theta.copy())
        return self._believed if self.settings.feedforward else None

    def forget(self) -> None:
        """See Controller.forget."""
        self.identified.reset()
        self._believed = self.mpc.residual

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        self.forget()
        self._commanded[...] = thrust_at_start(window, self.vehicle)

    def prepare(self, window: Window) -> None:
        """Does nothing: the coefficients of the next step depend on its measurement."""

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant; rotor speeds that are not measured are replaced by the commanded ones."""
        inner = super().instant(told, state)

        def identify() -> None:
            speed = told.speed
            if not told.turning[0]:
                speed = np.sqrt(np.maximum(self._commanded, 0.0) / self.vehicle.static_thrust_coefficient)
            self.identified.update(state, told.force, speed)

        use = python(lambda: self.mpc.set_parameters(self.identified.theta))
        operations = [python(identify, told.read), use, *inner.operations, copy(self._commanded, inner.command)]
        return inner._replace(operations=operations)

    def log(self) -> dict[str, float]:
        """See Controller.log: the coefficients in use."""
        return self.identified.log()


@dataclass(frozen=True, kw_only=True)
class RLSMPC(PredictivePart):
    """MPC whose blade-element model is identified in flight.
    reference_period: s between new references from the identified coefficients; 0: never."""

    former_kind = "rls_mpc"
    residual: Literal["blade_element"] = key("blade_element", RESIDUAL)
    reference_period: float = key(
        REQUIRED, "time between new references from the identified coefficients; 0: never", "[0, 3600]", "s"
    )
    rls: Identification = key(REQUIRED, "recursive least squares in flight", tuned=".noise=0.01..1:log")

    def build(self, given: Given) -> Any:
        """See ControllerPart."""
        from quadexp.models.blade_element import blade_element_residual

        estimator = self.rls.build(given.vehicle, self.backend)
        identified = IdentifiedCoefficients(estimator, self.rls.change_threshold)
        residual = blade_element_residual(given.vehicle, estimator.initial, identified.source)
        mpc = ModelPredictiveController(given.vehicle, residual, part(MPCSettings, self), backend=self.backend)
        return IdentifyingController(mpc, identified, self.reference_period)
