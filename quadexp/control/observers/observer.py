"""What every observer does in a control step: delivered thrusts, one compiled update, the belief for the controller.

The update is a function of the observer's state s and of what is known at a control instant,

    (s, x, reading, read, thrust, mean, theta, settings) -> s_next, belief      belief = [F, tau, w, s_T, s_air], (11,)

with the accelerometer's reading (3,), whether it was read now, the delivered thrusts now and over the last control
period, (n,) each, and the parameters of the controller's model of the air. Where nothing was read it predicts, and what
it finds by other sensors goes on. It runs from the second instant on: before the first nothing was flown.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.backend import BufferedFunction, realise
from quadexp.compile.symbolic import ca
from quadexp.control.base import Belief, Controller, Window, belief_of, no_belief
from quadexp.control.delivered import Delays, DeliveredThrust
from quadexp.control.instant import YES, Instant, Told, believing, call, copy, instant_of, move
from quadexp.control.mpc.believed_world import Estimator
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.online_mpc import AdaptingController, IdentifyingController
from quadexp.control.part import Remedy
from quadexp.control.wrapped import WrappedController, innermost, thrust_at_start
from quadexp.errors import UsageError
from quadexp.models.residual import Residual, no_residual
from quadexp.names import named
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import named_symbols
from quadexp.physics.vehicle import Vehicle

COLUMNS = (
    *(f"observer_force_{axis}" for axis in "xyz"),
    *(f"observer_torque_{axis}" for axis in "xyz"),
    *(f"observer_wind_{axis}" for axis in "xyz"),
    "observer_thrust_scale",
    "observer_air_scale",
)


@keyed
class ObserverPart(Remedy):
    """What every observer has."""

    prefix = "observer."
    believes = True

    torque_bandwidth: float = key(
        15.0, "of the estimated torque; 0: no torque", "[0, 1000]", "rad/s", tuned="1..100:log"
    )
    torque_limit: float = key(
        100.0, "largest estimated torque on an axis, over its inertia", "(0, 1e6]", "rad/s^2", when="torque_bandwidth"
    )
    targets: bool = key(
        True, "recompute attitudes and thrusts of the reference so that they hold the path under what is estimated"
    )
    dead_time: float | None = key(
        None, "of thrust, where rotor speeds are not measured; null: the controller's", "[0, 0.5]", "s"
    )
    motor_lag: float | None = key(
        None, "time constant of the rotors, likewise; null: the controller's", "[0, 0.5]", "s"
    )


class Update(NamedTuple):
    """What an observer is made of.

    function: see the module. settings: its last argument. begin: state of the observer for the first measurement,
    from that state, (13,).
    """

    function: ca.Function
    settings: np.ndarray
    begin: Any


class Observer(WrappedController):
    """A controller that is told what an observer estimates; columns observer_.. of a flight: SI, forces and wind in the
    world, torques in body axes.

    Under an MPC the update is a part of its step (control.mpc.believed_world); any other controller is told before each
    of its steps.
    """

    def __init__(self, inner: Controller, update: Update, config: ObserverPart) -> None:
        super().__init__(inner)
        self.finds_torque = config.torque_bandwidth > 0
        stated = {"dead_time": config.dead_time, "known_lag": config.motor_lag}
        known = [known_delay(given, inner, name) for name, given in stated.items()]
        self._begin, self._world = update.begin, None
        if isinstance(inner, PredictiveController):
            inner.targets = config.targets
            delays = Delays(inner.control_period, *known)
            self._world = inner.observed_by(Estimator(update.function, update.settings, delays))
            self._belief = self._world.numbers
            return
        self.delivered = DeliveredThrust(inner.vehicle, inner.control_period, *known, backend=inner.backend)
        shared = {"theta": parameters_of(innermost(inner))}
        self._update = BufferedFunction(realise(update.function, inner.backend), shared)
        self._given, self._result = self._update.arguments, self._update.results
        self._given["settings"].ravel()[:] = update.settings
        self._belief, self._flown = np.hstack([*no_belief()]), np.zeros(1)

    @property
    def estimate(self) -> np.ndarray:
        """The state of the update, which may be changed between two steps."""
        return self._given["s"] if self._world is None else self._world.estimate

    @property
    def settings(self) -> np.ndarray:
        """The numbers of the update, likewise."""
        return self._given["settings"] if self._world is None else self._world.settings

    @property
    def numbers(self) -> np.ndarray:
        """What is believed since the last step, (11,), in the order of Belief."""
        return self._belief

    @property
    def belief(self) -> Belief:
        """What is believed since the last step."""
        return belief_of(self._belief)

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset: nothing is believed of the world yet."""
        super().reset(x, window)
        if self._world is not None:
            self._world.reset(self._begin(x))
            return
        self.delivered.reset(thrust_at_start(window, self.vehicle))
        self._given["s"].ravel()[:] = self._begin(x)
        self._belief[...], self._flown[0] = np.hstack([*no_belief()]), 0.0

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        believe = [] if self._world is not None else believing(self.inner, self._belief)
        inner = instant_of(self.inner, told, state)
        operations, logged = inner.operations, (*inner.logged, self._belief)
        if self._world is None:
            given, result, delivered, flown = self._given, self._result, self.delivered, self._flown
            places = {"x": state, "reading": told.force, "read": told.read}
            places |= {"thrust": delivered.thrust, "mean": delivered.mean}
            observing = [*delivered.before(told), *(copy(given[name], place) for name, place in places.items())]
            observing += [
                move(flown, YES, told.read),
                call(self._update, flown),
                move(given["s"], result["s_next"], flown),
            ]
            observing += [move(self._belief, result["belief"], flown), move(flown, YES)]
            operations = [*observing, *believe, *operations, *delivered.after(inner.command)]
        return inner._replace(operations=operations, logged=logged)

    def log(self) -> dict[str, float]:
        """See Controller.log: the estimates, beside the columns of the controller."""
        return self.inner.log() | named(COLUMNS, self._belief.tolist())


def believer(controller: Controller, name: str) -> Any:
    """The controller, which can be told what an observer estimates.

    Raises UsageError where it cannot, or where it identifies its own model from the same accelerometer.
    """
    if isinstance(innermost(controller), (IdentifyingController, AdaptingController)):
        raise UsageError(
            f"observer={name}: this controller explains the accelerometer by what it learns in flight; an"
            " observer would explain the same readings a second time. Take one of them"
        )
    if not hasattr(controller, "believe"):
        raise UsageError(f"observer={name}: this controller cannot be told what an observer estimates; an MPC can")
    return controller


def known_delay(given: float | None, controller: Any, name: str) -> float:
    """What an observer is told of a delay, else what its controller was told (s)."""
    return float(getattr(getattr(controller, "settings", None), name, 0.0)) if given is None else given


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


def arguments(vehicle: Vehicle, states: int, parameters: int, settings: int) -> dict[str, ca.MX]:
    """Symbols of an update's arguments, in their order."""
    n = vehicle.n_rotors
    sizes = {"s": states, "x": 13, "reading": 3, "read": 1, "thrust": n, "mean": n}
    sizes |= {"theta": parameters, "settings": settings}
    return named_symbols(ca.MX, sizes)
