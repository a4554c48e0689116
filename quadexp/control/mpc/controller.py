"""The model predictive controller with the interface of all controllers, with dead-time prediction and a belief."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.control.base import Belief, Controller, Measurement, Window
from quadexp.control.control_step import Call, ControlStep, InCalls, InputArrays, copy
from quadexp.control.mpc.dead_time import DeadTimePredictor, MotorLead
from quadexp.control.mpc.mpc import ModelPredictiveController, StepRecord
from quadexp.models.residual import Residual
from quadexp.physics.rigid_body import N_DISTURBANCE
from quadexp.physics.state import N_STATE, POSITION
from quadexp.plugin import service

SURELY = 1 - 1e-9  # of a distance: what is nearer is nearer in any order of summation


class PredictiveController(InCalls):
    """A ModelPredictiveController as a Controller (see control.base). record: of its last step."""

    reference_period = 0.0
    learns = False  # whether it explains the accelerometer by what it learns in flight

    def __init__(self, mpc: ModelPredictiveController) -> None:
        self.mpc = mpc
        self.believed: Any = None  # a world to plan in, made by the first belief (the service `believed_world`)
        self.targets = False  # whether references are recomputed to hold the path in the assumed world
        self.vehicle = mpc.vehicle
        self.settings = mpc.settings
        self.backend = mpc.backend
        self.control_period = mpc.settings.control_period
        self.node_times = mpc.settings.dead_time + mpc.node_times  # the first is when a command sent now begins to act
        self.predictor: Any = DeadTimePredictor(mpc) if mpc.settings.dead_time or mpc.settings.known_lag else None
        self.lead = MotorLead(mpc.limits, mpc.settings, mpc.backend) if mpc.settings.motor_lead else None
        self._prepared: Window | None = None
        self.unprepared = np.ones(1)  # whether the reference is to be looked up
        self.record: StepRecord
        self._x0: np.ndarray = mpc.step.arguments["x0"]
        self._reference = mpc.reference
        self.residual_name = mpc.residual.name
        self.source = mpc.residual.source

    @property
    def residual(self) -> Residual | None:
        """What references contain of the air: the model where it feeds forward."""
        known = self.mpc.residual
        return known if self.settings.feedforward and not known.is_zero else None

    def forget(self) -> None:
        """See Controller.forget; nothing is learned in flight."""

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        if self.believed is not None:
            self.mpc.set_disturbance(np.zeros(N_DISTURBANCE))
        if self.predictor is not None:
            self.predictor.reset(np.clip(window.input[0], self.vehicle.thrust_min, self.vehicle.thrust_max))
            x = self.predictor.predict(x)
        if self.lead is not None:
            x = x[:N_STATE]
        states = window.state.copy()
        self._within_reach(x, states)
        self.mpc.reset(x, states, window.input)
        if self.believed is not None:
            self.believed.reset(None)

    @property
    def believed_numbers(self) -> np.ndarray:
        """The belief in whose world every step is planned from now on, in the order of Belief; (11,).

        Raises QuadexpError where the MPC was made without `disturbed`.
        """
        if self.believed is None:
            make = service("believed_world", "a belief of what acts on the vehicle")
            self.believed = make(self.mpc, self.node_times, targets=self.targets, air=self.residual)
            self._running = None
        numbers: np.ndarray = self.believed.stated
        return numbers

    def believe(self, belief: Belief) -> None:
        """Plan the next step, and all after it until set otherwise, in the world of a belief."""
        self.believed_numbers[:] = np.hstack([*belief])

    def prepare(self, window: Window) -> None:
        """Do what the next step can do before its measurement; `step` with this window, the same object, is faster.

        To be called between two steps. The answer is that of a step without it, to rounding. Where there is a belief it
        does nothing: that of the next step depends on its measurement.
        """
        if self.believed is not None:
            return
        self.mpc.prepare(window.state, window.input)
        self._prepared = window

    def step(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, StepRecord]:
        """See Controller.step."""
        self.mpc.prepared = self.mpc.prepared and self._prepared is window and self.believed is None
        self.unprepared[0] = not self.mpc.prepared
        self._prepared = None
        return super().step(measurement, window)

    def control_step(self, inputs: InputArrays, state: np.ndarray) -> ControlStep:
        """See control.control_step."""
        mpc = self.mpc
        x0 = self._x0
        X_ref, U_ref = self._reference
        if self.believed is None:
            look = Call("window", X_ref[:, :N_STATE], other=U_ref, when=self.unprepared)
            calls = [look]
            x = state
        else:
            calls, x = self.believed.before(inputs, state)
        if self.predictor is not None:
            predicted, x = self.predictor.before(x)
            calls += predicted
        calls += [copy(x0, x[: len(x0)]), Call("finite", source=x0)]
        limit = self.settings.distance_limit * SURELY
        calls += [Call("near", source=x0, other=X_ref, factor=limit), Call("plan", act=self._plan)]
        command = mpc.prediction[1][0]
        if self.lead is not None:
            inverted, command = self.lead.after(command, x[N_STATE:])
            calls += inverted
        if self.predictor is not None:
            calls += self.predictor.after(command)  # in an assumed world: what is delivered of the command
        if self.believed is not None:
            delivering, command = self.believed.after(command)
            calls += delivering
        layers: list[Any] = [mpc, self.believed, self.predictor]
        kept = tuple(layer.memory for layer in layers if hasattr(layer, "memory"))
        return ControlStep(calls, command, lambda _: self.record, plan=self, memory=kept)

    def _plan(self) -> None:
        """The MPC's step from what lies in its arrays; what is out of the ordinary is here, and not in C."""
        mpc = self.mpc
        x0 = self._x0
        X_ref, U_ref = self._reference
        if self._within_reach(x0, X_ref):
            mpc.prepared = False
        if mpc.prepared:
            _, self.record = mpc.feedback(x0.copy())
        else:
            finite = self.believed is not None and self.believed.finite
            _, self.record = mpc.command(x0, X_ref, U_ref, finite=finite)

    def _within_reach(self, x: np.ndarray, reference: np.ndarray) -> bool:
        """Shift the reference, (k, 13 ..), towards the vehicle where it is further away than distance_limit L, and
        whether it was.

        With e = p - p*_0 and |e| > L every position is shifted by e (1 - L / |e|), as flight stacks limit the position
        error. Without a limit the quadratic cost demands a speed that grows with the distance: from 28 m away the
        vehicle arrives at 30 m/s, which one iteration per step cannot brake in time.
        """
        at = x.item
        to = reference.item
        limit = self.settings.distance_limit
        if not math.dist((at(0), at(1), at(2)), (to(0), to(1), to(2))) > limit:
            return False
        error = x[POSITION] - reference[0, POSITION]
        reference[:, POSITION] += error * (1 - limit / math.sqrt(error.dot(error)))
        return True

    def log(self) -> dict[str, float]:
        """See Controller.log; everything is in the step record."""
        return {}


def as_controller(controller: Controller | ModelPredictiveController) -> Controller:
    """The controller; a ModelPredictiveController as a PredictiveController."""
    return PredictiveController(controller) if isinstance(controller, ModelPredictiveController) else controller
