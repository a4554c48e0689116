"""The model predictive controller with the interface of all controllers, with dead-time prediction and a belief."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.control.base import Controller, Measurement, Window
from quadexp.control.belief import Belief
from quadexp.control.instant import Instant, Operation, Told, copy
from quadexp.control.mpc.believed_world import BelievedWorld, Estimator
from quadexp.control.mpc.dead_time import DeadTimePredictor
from quadexp.control.mpc.motor_lead import MotorLead
from quadexp.control.mpc.mpc import ModelPredictiveController, StepRecord
from quadexp.control.mpc.settings import MPCSettings
from quadexp.models.residual import Residual
from quadexp.physics.rigid_body import N_DISTURBANCE
from quadexp.physics.state import N_STATE, POSITION


class PredictiveController:
    """A ModelPredictiveController as a Controller (see control.base)."""

    reference_period = 0.0

    def __init__(self, mpc: ModelPredictiveController) -> None:
        self.mpc = mpc
        self.believed: BelievedWorld | None = None  # made by the first `believe`
        self.targets = False  # whether references are recomputed to hold the path in the believed world
        self.vehicle, self.settings, self.backend = mpc.vehicle, mpc.settings, mpc.backend
        self.control_period = mpc.settings.control_period
        self.node_times = mpc.settings.dead_time + mpc.node_times  # the first is when a command sent now begins to act
        self.predictor: Any = DeadTimePredictor(mpc) if mpc.settings.dead_time or mpc.settings.known_lag else None
        self.lead = MotorLead(mpc.vehicle, mpc.settings, mpc.backend) if mpc.settings.motor_lead else None
        self._prepared: Window | None = None
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
        if self.believed is not None:
            self.mpc.set_disturbance(np.zeros(N_DISTURBANCE))
        if self.predictor is not None:
            self.predictor.reset(np.clip(window.input[0], self.vehicle.thrust_min, self.vehicle.thrust_max))
            x = self.predictor.predict(x)
        if self.lead is not None:
            x = x[:N_STATE]
        self.mpc.reset(x, self._within_reach(x, window.state), window.input)
        if self.believed is not None:
            self.believed.reset(None)

    def believe(self, belief: Belief) -> None:
        """Plan the next step, and all after it until told otherwise, in the world of a belief.

        Raises QuadexpError where the MPC was made without `disturbed`.
        """
        if self.believed is None:
            self.believed = BelievedWorld(self.mpc, self.node_times, targets=self.targets, air=self.residual)
        self.believed.belief = belief

    def use(self, settings: MPCSettings, predictor: Any, lead: MotorLead | None) -> None:
        """Go on with other settings, see ModelPredictiveController.use, and what they know of dead time and lag.

        predictor: as DeadTimePredictor, for settings.dead_time and settings.motor_lead; None: there is neither.
        """
        self.mpc.use(settings)
        self.settings, self.predictor, self.lead, self._prepared = settings, predictor, lead, None
        self.node_times = settings.dead_time + self.mpc.node_times
        if self.believed is not None:
            self.believed.retime(self.node_times)

    def observed_by(self, estimator: Estimator) -> BelievedWorld:
        """Plan every step in the world that an estimator finds, which is a part of the step from now on."""
        self.believed = BelievedWorld(
            self.mpc, self.node_times, targets=self.targets, air=self.residual, estimator=estimator
        )
        return self.believed

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
        x, world, predictor = measurement.state, self.believed, self.predictor
        if world is None and predictor is None:
            return self._answer(x, window)
        if world is not None:
            x, states, inputs = world.enter(measurement, window)
        if predictor is not None:
            x = predictor.predict(x)
        if self.lead is not None:
            x, acting = x[:N_STATE], x[N_STATE:]
        if world is None:
            thrust, record = self._answer(x, window)
        else:
            thrust, record = self.mpc.command(x, self._within_reach(x, states), inputs, finite=world.finite)
        if self.lead is not None:
            thrust = self.lead.command(thrust, acting)
        if predictor is not None:
            predictor.record(thrust)  # in a believed world: what is delivered of the command
        if world is not None:
            thrust = world.leave(thrust)
        return thrust, record

    def instant(self, told: Told) -> Instant | None:
        """See control.instant; none with thrusts among the states of the plan, or a belief that somebody else has."""
        world, mpc, lead = self.believed, self.mpc, self.lead
        step, _ = mpc.functions
        x0, X_ref = step.arguments["x0"], mpc.reference[0]
        if (
            type(mpc) is not ModelPredictiveController
            or len(x0) != N_STATE
            or (world is not None and not (world.estimates and world.in_place))
        ):
            return None
        if self.predictor is not None and type(self.predictor) is not DeadTimePredictor:
            return None
        if world is None:
            operations, x = [Operation("window", X_ref, other=mpc.reference[1])], told.state
        else:
            operations, x = world.before(told)
        if self.predictor is not None:
            predicted, x = self.predictor.before(x)
            operations += predicted
        acting = x[N_STATE:]
        operations += [copy(x0, x[:N_STATE]), Operation("finite", source=x0)]
        limit = self.settings.distance_limit * (1 - 1e-9)
        operations += [Operation("near", source=x0, other=X_ref, factor=limit), Operation("plan")]
        thrust = mpc.prediction[1][0]
        if lead is not None:
            inverted, thrust = lead.operations(thrust, acting)
            operations += inverted
        if self.predictor is not None:
            operations += self.predictor.after(thrust)
        if world is not None:
            left, thrust = world.after(thrust)
            operations += left
        resumed = () if world is None else (world.go_on,)
        return Instant(operations, thrust, mpc=mpc, resumed=resumed, ready=(lambda: not mpc.cold,))

    def _answer(self, x: np.ndarray, window: Window) -> tuple[np.ndarray, StepRecord]:
        """x: predicted state when the command begins to act; window: the reference from then on."""
        prepared, self._prepared = self._prepared, None
        if prepared is window and self.mpc.prepared and not self._too_far(x, window.state):
            return self.mpc.feedback(x)
        return self.mpc.command(x, self._within_reach(x, window.state), window.input)

    def _within_reach(self, x: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """The reference, shifted towards the vehicle where it is further away than distance_limit L.

        With e = p - p*_0 and |e| > L every position is shifted by e (1 - L / |e|), as flight stacks limit the position
        error. Without a limit the quadratic cost demands a speed that grows with the distance: from 28 m away the
        vehicle arrives at 30 m/s, which one iteration per step cannot brake in time.
        """
        if not self._too_far(x, reference):
            return reference
        error, near = x[POSITION] - reference[0, POSITION], reference.copy()
        near[:, POSITION] += error * (1 - self.settings.distance_limit / math.sqrt(error.dot(error)))
        return near

    def _too_far(self, x: np.ndarray, reference: np.ndarray) -> bool:
        at, to = x.item, reference.item
        return math.dist((at(0), at(1), at(2)), (to(0), to(1), to(2))) > self.settings.distance_limit

    def log(self) -> dict[str, float]:
        """See Controller.log; everything is in the step record."""
        return {}


def as_controller(controller: Controller | ModelPredictiveController) -> Controller:
    """The controller; a ModelPredictiveController as a PredictiveController."""
    return PredictiveController(controller) if isinstance(controller, ModelPredictiveController) else controller
