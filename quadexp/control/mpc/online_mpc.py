"""Model predictive control with a model of the air whose weights adapt in flight.

Before every step one compiled function (quadexp.air.online) takes the last accelerometer sample into the weights; they
are runtime parameters of the control step, so nothing is compiled again. The last of the summed residuals adapts, the
others are known. The reference's attitudes and thrusts are recomputed with the newest weights every reference_period.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from quadexp.air.adapting import Adapting
from quadexp.air.base import Residual
from quadexp.air.online import Law, prior_belief, update_function
from quadexp.air.sum import sum_residual
from quadexp.compile.backend import BufferedFunction, realise
from quadexp.config.learned import AdaptKeys
from quadexp.control.base import Measurement, Window
from quadexp.control.delivered import DeliveredThrust
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import ModelPredictiveController, StepRecord
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.wrapped import thrust_at_start
from quadexp.physics.vehicle import Vehicle


class AdaptingController(PredictiveController):
    """See Controller.

    adapting: the residual that adapts. known: what is summed with it and does not adapt. settings, adapt: of the MPC
    and of the adaptation. reference_period: s, 0 keeps the first reference.
    theta: weights in use, in the adapting residual's parameters. samples: how many have been used.
    """

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
        self.adapting, self.adapt, self.reference_period = adapting, adapt, reference_period
        fixed = sum_residual(known) if known else None
        function = update_function(
            vehicle, adapting, fixed, Law(adapt.law, adapt.fitc), compiled=self.backend == "compiled"
        )
        self._update = BufferedFunction(realise(function, self.backend))
        given, found = self._update.arguments, self._update.results
        period = self.control_period * adapt.every
        given["variance"][...], given["decay"][...] = adapt.noise**2, math.exp(-period / adapt.memory)
        given["tracking"][...], given["tracking_rate"][...] = period * adapt.tracking, adapt.tracking_rate
        if fixed is not None:
            given["known_theta"][...] = fixed.theta
        self._belief, self._new_belief = given["belief"], found["new_belief"]
        self._inputs = [given[name] for name in ("x", "f", "u")]
        self._path, self.theta, self.innovation = given["path"], found["theta"], found["innovation"]
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
        return self._known if self.settings.feedforward else None

    def forget(self) -> None:
        """See Controller.forget: back to the prior."""
        self._belief[...] = prior_belief(self.adapting)
        self.theta[...], self.innovation[...], self.samples, self._wait = self.adapting.residual.theta, 0.0, 0, 0
        self._take()

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        self.forget()
        self._delivered.reset(thrust_at_start(window, self.vehicle))

    def prepare(self, window: Window) -> None:
        """Does nothing: the weights of the next step depend on its measurement."""

    def step(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, StepRecord]:
        """See Controller.step; without an accelerometer reading the weights stay."""
        thrust = self._delivered.now(measurement)
        if measurement.specific_force is not None:
            self._wait -= 1
            if self._wait < 0:
                self._wait = self.adapt.every - 1
                self._learn(measurement, thrust, window)
        command, record = super().step(measurement, window)
        self._delivered.record(command)
        return command, record

    def log(self) -> dict[str, float]:
        """See Controller.log: what the last sample was away from its prediction."""
        return {f"innovation_{axis}": float(value) for axis, value in zip("xyz", self.innovation, strict=True)}

    def _learn(self, measurement: Measurement, thrust: np.ndarray, window: Window) -> None:
        """One update."""
        x, f, u = self._inputs
        x[...], f[...], u[...] = measurement.state, measurement.specific_force, thrust
        self._path[:3], self._path[3:] = window.position[0], window.position[1]
        self._update()
        self._belief[...] = self._new_belief
        self.samples += 1
        self._take()

    def _take(self) -> None:
        self._weights[...] = self.theta
        self.mpc.set_parameters(self._all)
