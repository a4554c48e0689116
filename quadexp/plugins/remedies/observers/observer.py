"""What every observer does in a control step: delivered thrusts, one compiled update, the belief for the controller.

The update is a function of the observer's state s and of what is known at a control instant,

    (s, x, reading, read, thrust, mean, theta, settings) -> s_next, belief      belief = [F, tau, w, s_T, s_air], (11,)

with the accelerometer's reading (3,), whether it was read now, the delivered thrusts now and over the last control
period, (n,) each, and the parameters of the controller's model of the air. Where nothing was read it predicts, and what
it finds by other sensors goes on. It runs from the second instant on: before the first nothing was flown.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.compile.backend import resolve
from quadexp.compile.memory import Memory
from quadexp.compile.symbolic import ca
from quadexp.control.base import Controller, Window
from quadexp.control.control_step import ControlStep, InputArrays, control_step_of
from quadexp.control.inputs import Circumstances, Inputs
from quadexp.control.layer import NO_BELIEF, Layer, LayerPart
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.wrapped import WrappedController, air_of, innermost, parameters_of
from quadexp.errors import UsageError
from quadexp.models.residual import Residual, no_residual
from quadexp.names import named
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import named_symbols
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.remedies.believed_world import BelievedWorld, Estimator

COLUMNS = (
    *(f"observer_force_{axis}" for axis in "xyz"),
    *(f"observer_torque_{axis}" for axis in "xyz"),
    *(f"observer_wind_{axis}" for axis in "xyz"),
    "observer_thrust_scale",
    "observer_air_scale",
)


@keyed
class ObserverPart(LayerPart):
    """What every observer has. Columns observer_.. of a flight: SI, forces and wind in the world, torques in body
    axes."""

    prefix = "observer."
    believes = True
    logged = {"belief": COLUMNS}

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

    def update(self, vehicle: Vehicle, air: Residual, about: Circumstances) -> ca.Function:
        """See the module. air: the controller's model, which may be none."""
        raise NotImplementedError

    def settings(self, period: float) -> np.ndarray:
        """The last argument of `update`."""
        raise NotImplementedError

    def begin(self, x: np.ndarray) -> np.ndarray:
        """Of the estimate, as the flight begins in a state, (13,)."""
        raise NotImplementedError

    def remembers(self, inputs: Inputs) -> dict[str, int]:
        """See LayerPart: the estimate, and whether anything has been read."""
        return {"estimate": self.begin(np.zeros(N_STATE)).size, "flown": 1}

    def start(self, inputs: Inputs, x: np.ndarray, thrust: np.ndarray) -> dict[str, np.ndarray]:
        """See LayerPart."""
        return {"estimate": self.begin(x)}

    def before(self, vehicle: Vehicle, inputs: Inputs, memory: Any) -> dict[str, Any]:
        """The update, from the first reading on."""
        air = inputs.residual or no_residual(vehicle)
        read = inputs.fresh[0]
        flown = ca.fmax(memory.flown, inputs.fresh[0])
        known = inputs.state, inputs.specific_force, read, inputs.delivered, inputs.mean, inputs.theta
        update = self.update(vehicle, air, inputs.about)
        estimate, belief = update(memory.estimate, *known, ca.DM(self.settings(inputs.period)))
        estimate = ca.if_else(flown, estimate, memory.estimate)
        belief = ca.if_else(flown, belief, ca.DM(NO_BELIEF))
        return {"estimate": estimate, "flown": 1, "belief": belief}

    def put(self, controller: Any) -> Observer | ObservingMPC:
        """The controller that is given it, where it can be."""
        core = innermost(controller)
        about = Circumstances(
            controller.control_period,
            known_delay(self.dead_time, controller, "dead_time"),
            known_delay(self.motor_lag, controller, "known_lag"),
            compiled=resolve(controller.backend) == "compiled",
        )
        if isinstance(controller, PredictiveController):
            return ObservingMPC(controller, self, about)
        return Observer(controller, self, about, air_of(core), {"theta": parameters_of(core)})


class Observer(Layer):
    """A controller that is given before each of its steps what an observer estimates."""

    @property
    def finds_torque(self) -> bool:
        """Whether the controller is given a torque."""
        part: Any = self.part
        return part.torque_bandwidth > 0

    @property
    def numbers(self) -> np.ndarray:
        """What is assumed since the last step, (11,), in the order of Belief."""
        return self.results["belief"]


class ObservingMPC(WrappedController):
    """An MPC with an observer: the update is a part of its step (plugins.remedies.believed_world)."""

    def __init__(self, wrapped: PredictiveController, part: ObserverPart, about: Circumstances) -> None:
        super().__init__(wrapped)
        self.part = part
        self.finds_torque = part.torque_bandwidth > 0
        wrapped.targets = part.targets
        function = part.update(wrapped.vehicle, air_of(wrapped), about)
        estimator = Estimator(function, part.settings(about.period), about.delays)
        self._world = BelievedWorld(
            wrapped.mpc, wrapped.node_times, targets=wrapped.targets, air=wrapped.residual, estimator=estimator
        )
        wrapped.believed = self._world
        self.numbers = self._world.numbers

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset: nothing is assumed of the world yet."""
        super().reset(x, window)
        self._world.reset(self.part.begin(x))

    def starts(self, x: np.ndarray, thrust: np.ndarray) -> list[tuple[Memory, dict[str, Any]]]:
        """See Layer."""
        return [(self._world.memory, self._world.start(self.part.begin(x), thrust))]

    def control_step(self, inputs: InputArrays, state: np.ndarray) -> ControlStep:
        """See control.control_step."""
        step = control_step_of(self.wrapped, inputs, state)
        return step._replace(logged=(*step.logged, self.numbers))

    def log(self) -> dict[str, float]:
        """See Controller.log: the estimates, beside the columns of the controller."""
        return self.wrapped.log() | named(COLUMNS, self.numbers.tolist())


def believer(controller: Controller, name: str) -> Any:
    """The controller, which can be given what an observer estimates.

    Raises UsageError where it cannot, or where it identifies its own model from the same accelerometer.
    """
    if getattr(innermost(controller), "learns", False):
        raise UsageError(
            f"observer={name}: this controller explains the accelerometer by what it learns in flight; an"
            " observer would explain the same readings a second time. Take one of them"
        )
    if not hasattr(controller, "believe"):
        raise UsageError(f"observer={name}: this controller cannot be given what an observer estimates; an MPC can")
    return controller


def known_delay(stated: float | None, controller: Any, name: str) -> float:
    """What an observer is given a delay, else what its controller was given (s)."""
    if stated is None:
        return float(getattr(getattr(controller, "settings", None), name, 0.0))
    return stated


def arguments(vehicle: Vehicle, states: int, parameters: int, settings: int) -> dict[str, ca.MX]:
    """Symbols of an update's arguments, in their order."""
    n = vehicle.n_rotors
    sizes = {"s": states, "x": 13, "reading": 3, "read": 1, "thrust": n, "mean": n}
    sizes["theta"] = parameters
    sizes["settings"] = settings
    return named_symbols(ca.MX, sizes)
