"""A late state brought to now by the controller's model and the commands that were sent.

    x^(t) = phi(tau; x(t - tau), thrusts over [t - tau, t])

phi: Runge-Kutta steps of at most STEP, the last parts of the time; the thrust of each is its mean over that part, after
the dead time and lag of the commands (delivered.py). Where an observer is inside, phi is in the world that it believed
in at the last instant: v' = F_air(v - w, s T) + F / m .., see control.belief. The prediction starts from the newest
measurement at every instant (not Smith's form, whose model drifts). It needs no gyroscope and no accelerometer, but a
model: an error a of its acceleration leaves a tau^2 / 2 in the position.

An MPC predicts the dead time of its commands itself. Any other controller is told the state, and the reference, of the
time at which its command begins to act: phi goes on over the dead time, under the commands that have been sent.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.base import Controller, Window
from quadexp.control.built import built
from quadexp.control.delay.strapdown import KnownDelay
from quadexp.control.delivered import SETTLED, SentCommands
from quadexp.control.instant import Instant, Told, call, copy, instant_of, python
from quadexp.control.wrapped import WrappedController, innermost, layers, thrust_at_start
from quadexp.models.residual import Residual, no_residual
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import named_function, named_symbols, unit
from quadexp.physics.integrator import rk4_step_with_input
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import ATTITUDE, N_STATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

STEP = 0.02  # s, of the integration


class Prediction(WrappedController):
    """A controller that is told the state of now instead of that of `delay` (s) ago, predicted by a model.

    dead_time, lag: of commands (s). The model is that of the MPC inside; without one, the rigid body alone.
    """

    def __init__(self, inner: Controller, delay: float, dead_time: float, lag: float) -> None:
        super().__init__(inner)
        self.delay, self.dead_time, self.lag = delay, dead_time, lag
        model = getattr(innermost(inner), "mpc", None)
        self._observer: Any = next((one for one in layers(inner) if hasattr(one, "belief")), None)
        residual = no_residual(self.vehicle) if model is None else model.residual
        self.ahead = dead_time if model is None else 0.0  # an MPC predicts the dead time itself
        self.node_times = inner.node_times + self.ahead
        parts = math.ceil((delay + self.ahead) / STEP - 1e-9)
        reach = delay + dead_time + SETTLED * lag + self.control_period
        self.commands = SentCommands(self.vehicle.n_rotors, self.control_period, reach)
        self._predict: BufferedFunction | None = None
        self._believed: dict[str, np.ndarray] = {}  # where the MPC's step leaves what it believes in
        if parts:
            shared = {"commands": self.commands.values} | ({} if model is None else {"theta": model.parameters})
            world = None if self._observer is None else getattr(innermost(inner), "believed", None)
            if world is not None and model is not None:
                self._believed = {
                    "push": model.disturbance, "wind": world.numbers[6:9], "scale": world.numbers[9:10],
                }  # fmt: skip
                self._observer = None  # nothing is to be told
            function = built(inner.backend, prediction, self.vehicle, residual, parts, len(self.commands.values))
            self._predict = BufferedFunction(function, shared)
            self._arguments, self._now = self._predict.arguments, self._predict.results["now"]
            self._x = self._arguments["x"]
            self._arguments["scale"][0] = 1.0
            if model is None:
                self._arguments["theta"][...] = residual.theta
        self._since, self._shown = 0, -1.0
        self._young, self._moves = np.ones(1), np.zeros(1)  # whether `late` is to change, and is not 0
        self._inverse_inertia = np.linalg.inv(self.vehicle.inertia_matrix)

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        self._since, self._shown = 0, -1.0
        self._young[0], self._moves[0] = 1.0, 0.0
        self.commands.reset(thrust_at_start(window, self.vehicle))
        for name in self._believed:
            self._arguments[name][...] = name == "scale"
        super().reset(x, self._later(window) if self.ahead else window)

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        operations, now = [], state
        if self._predict is not None:
            operations = [python(self._grow, self._young), copy(self._x, state), copy(self._now, state)]
            if self._observer is not None:
                operations.append(python(self._tell_belief))
            operations.append(call(self._predict, self._moves))
            now = self._now
        if self.ahead:
            operations.append(python(lambda: told.look(self._later(told.window))))
        inner = instant_of(self.inner, told, now)
        operations += [*inner.operations, *self.commands.after(inner.command)]
        operations += [copy(self._arguments[name], value) for name, value in self._believed.items()]
        return inner._replace(operations=operations)

    def _grow(self) -> None:
        """Until `delay` has passed since the start, the measured state is that of the start."""
        late = min(self.delay, self._since * self.control_period)
        self._since += 1
        self._young[0], self._moves[0] = late < self.delay, late + self.ahead > 0
        if late + self.ahead and late != self._shown:
            self._divide(late)

    def _tell_belief(self) -> None:
        belief, told = self._observer.belief, self._arguments
        told["wind"][:], told["scale"][0] = belief.wind, belief.thrust_scale
        told["push"][:3] = belief.force / self.vehicle.mass
        told["push"][3:] = self._inverse_inertia @ belief.torque

    def _later(self, window: Window) -> Window:
        """The reference when a command of now begins to act; states and inputs are asked for then."""
        powers = [self.ahead**i / math.factorial(i) for i in range(len(window.position))]
        position, yaw = (
            np.stack([sum(p * row for p, row in zip(powers, one[i:], strict=False)) for i in range(len(one))])
            for one in (window.position, window.yaw)
        )
        return window._replace(position=position, yaw=yaw)

    def _divide(self, late: float) -> None:
        """Parts of the time, and the weights of commands in each."""
        before = np.arange(len(self._arguments["dt"]) - 1, -1, -1) * STEP  # from the end of the prediction
        ends, starts = (np.minimum(one, late + self.ahead) - self.ahead for one in (before, before + STEP))
        weights = self.commands.weights(-np.column_stack([starts, ends]), self.dead_time, self.lag)
        self._arguments["weights"].reshape(weights.shape)[...] = weights
        self._arguments["dt"][:], self._shown = starts - ends, late


def prediction(vehicle: Vehicle, residual: Residual, parts: int, commands: int) -> ca.Function:
    """The model's state after the thrusts of the last commands, in a believed world.

    Inputs: x (13,); commands (n, m) (N), the oldest first; weights (m, parts) on them of the thrusts in each part of
    the time, the first to act first; dt (parts,), for how long each acts (s); theta of the residual; wind (3,), world
    (m/s); push (6,): acceleration, world (m/s^2), and angular acceleration, body (rad/s^2), beyond the model; scale of
    the thrusts.
    """
    n = vehicle.n_rotors
    model = corrected_function(vehicle, residual)
    shapes = {"x": N_STATE, "commands": (n, commands), "weights": (commands, parts), "dt": parts}
    shapes |= {"theta": residual.function.size1_in(1), "wind": 3, "push": 6, "scale": 1}
    arguments = named_symbols(ca.MX, shapes)
    x, dt, theta, wind = (arguments[name] for name in ("x", "dt", "theta", "wind"))
    pushed = ca.vertcat(wind, ca.MX(4, 1), arguments["push"])
    thrusts = arguments["scale"] * (arguments["commands"] @ arguments["weights"])

    def slope(s: ca.MX, held: ca.MX) -> ca.MX:
        return model(s, held, theta) + pushed

    state = ca.vertcat(x[: VELOCITY.start], x[VELOCITY] - wind, x[VELOCITY.stop :])  # in the frame of the air
    for u, h in zip(ca.horzsplit(thrusts), ca.vertsplit(dt), strict=True):
        state = rk4_step_with_input(slope, state, [u] * 3, h)
    now = state[: ATTITUDE.start], unit(state[ATTITUDE]), state[VELOCITY] + wind, state[VELOCITY.stop :]
    return named_function("delay_prediction", arguments, {"now": ca.vertcat(*now)})


@keyed
class PredictionPart(KnownDelay):
    """A late state is brought to now by the controller's model."""

    dead_time: float | None = key(
        None, "dead time of commands; null: what the controller knows itself", "[0, 0.5]", "s"
    )
    motor_lag: float | None = key(
        None, "time constant of the rotors; null: what the controller knows itself", "[0, 0.5]", "s"
    )

    def around(self, controller: Any) -> Prediction:
        """See Remedy: the controller behind a prediction of its measurements by its own model."""
        settings = getattr(innermost(controller), "settings", None)
        told = [getattr(settings, name, 0.0) for name in ("dead_time", "known_lag")]
        given = (self.dead_time, self.motor_lag)
        dead_time, lag = (own if one is None else one for one, own in zip(given, told, strict=True))
        return Prediction(controller, self.time, dead_time, lag)
