"""A late state brought to now by the controller's model and the commands that were sent.

    x^(t) = phi(tau; x(t - tau), thrusts over [t - tau, t])

phi: Runge-Kutta steps of at most STEP, the last parts of the time; the thrust of each is its mean over that part, after
the dead time and lag of the commands (delivered.py). Where an observer is inside, phi is in the world that it assumed
in at the last instant: v' = F_air(v - w, s T) + F / m .., see control.belief. The prediction starts from the newest
measurement at every instant (not Smith's form, whose model drifts). It needs no gyroscope and no accelerometer, but a
model: an error a of its acceleration leaves a tau^2 / 2 in the position.

An MPC predicts the dead time of its commands itself. Any other controller is given the state, and the reference, of the
time at which its command begins to act: phi goes on over the dead time, under the commands that have been sent.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.base import N_BELIEF, Controller, Window
from quadexp.control.control_step import Call, InputArrays, python
from quadexp.control.inputs import Circumstances, Inputs
from quadexp.control.layer import NO_BELIEF, Layer
from quadexp.control.wrapped import innermost, layers
from quadexp.models.residual import Residual, no_residual
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import named_function, named_symbols, unit
from quadexp.physics.integrator import rk4_step_with_input
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import ATTITUDE, N_STATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.remedies.delay.strapdown import KnownDelay
from quadexp.plugins.remedies.sent_commands import SETTLED, weights_function

STEP = 0.02  # s, of the integration


def prediction(vehicle: Vehicle, residual: Residual, parts: int, commands: int) -> ca.Function:
    """The model's state after the thrusts of the last commands, in an assumed world.

    Inputs: x (13,); commands (n, m) (N), the oldest first; weights (m, parts) on them of the thrusts in each part of
    the time, the first to act first; dt (parts,), for how long each acts (s); theta of the residual; wind (3,), world
    (m/s); push (6,): acceleration, world (m/s^2), and angular acceleration, body (rad/s^2), beyond the model; scale of
    the thrusts.
    """
    n = vehicle.n_rotors
    model = corrected_function(vehicle, residual)
    shapes = {"x": N_STATE, "commands": (n, commands), "weights": (commands, parts), "dt": parts}
    shapes["theta"] = residual.function.size1_in(1)
    shapes["wind"] = 3
    shapes["push"] = 6
    shapes["scale"] = 1
    arguments = named_symbols(ca.MX, shapes)
    x = arguments["x"]
    dt = arguments["dt"]
    theta = arguments["theta"]
    wind = arguments["wind"]
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
class Prediction(KnownDelay):
    """A late state is brought to now by the controller's model: that of the MPC inside; without one, the rigid body
    alone."""

    dead_time: float | None = key(None, "dead time of commands; null: that of the controller", "[0, 0.5]", "s")
    motor_lag: float | None = key(None, "time constant of the rotors; null: that of the controller", "[0, 0.5]", "s")

    def remembers(self, inputs: Inputs) -> dict[str, int]:
        """See LayerPart: the last commands, the oldest first, and the newest; what an observer inside given last,
        (11,); instants since the start."""
        n = inputs.vehicle.n_rotors
        if not self._parts(inputs.about):
            return {}
        return {"commands": n * self._count(inputs.about), "sent": n, "believed": N_BELIEF, "since": 1}

    def start(self, inputs: Inputs, x: np.ndarray, thrust: np.ndarray) -> dict[str, np.ndarray]:
        """See LayerPart."""
        if not self._parts(inputs.about):
            return {}
        return {"commands": np.tile(thrust, self._count(inputs.about)), "believed": NO_BELIEF}

    def before(self, vehicle: Vehicle, inputs: Inputs, memory: Any) -> dict[str, Any]:
        """The prediction. Until `time` has passed since the start, the measured state is that of the start."""
        about = inputs.about
        residual = inputs.residual or no_residual(vehicle)
        parts = self._parts(about)
        if not parts:
            return {}
        elapsed = memory.since * about.period
        late = ca.fmin(self.time, elapsed)
        begun = self._times(about, parts, self.time)
        begins = self._times(about, parts, late)
        times = ca.if_else(elapsed < self.time, begins, begun, True)
        dt = times[:parts]
        weights = ca.reshape(times[parts:], -1, parts)
        commands = ca.vertcat(memory.commands[vehicle.n_rotors :], memory.sent)
        force, torque, wind, scale, _ = ca.vertsplit(memory.believed, [0, 3, 6, 9, 10, 11])
        spin = ca.inv(ca.DM(vehicle.inertia_matrix)) @ torque
        push = ca.vertcat(force / vehicle.mass, spin)
        predict = prediction(vehicle, residual, parts, self._count(about))
        history = ca.reshape(commands, vehicle.n_rotors, -1)
        now = predict(inputs.state, history, weights, dt, inputs.theta, wind, push, scale)
        now = ca.if_else(late + about.ahead > 0, now, inputs.state)
        return {"commands": commands, "since": memory.since + 1, "state": now}

    def _times(self, about: Circumstances, parts: int, late: Any) -> Any:
        """How long each part of the time acts (parts,), and the weights of commands in it (m parts,)."""
        before = ca.DM(np.arange(parts - 1, -1, -1) * STEP)  # from the end of the prediction
        ends = ca.fmin(before, late + about.ahead) - about.ahead
        starts = ca.fmin(before + STEP, late + about.ahead) - about.ahead
        spans = ca.horzcat(-starts, -ends).T
        weigh = weights_function(self._count(about), about.period, parts)
        weights = weigh(spans, [about.dead_time, about.lag])
        return ca.vertcat(starts - ends, ca.vec(weights[::-1, :]))

    def _parts(self, about: Circumstances) -> int:
        """In how many parts of at most STEP the time is predicted."""
        return math.ceil((self.time + about.ahead) / STEP - 1e-9)

    def _count(self, about: Circumstances) -> int:
        """How many commands may act yet."""
        reach = self.time + about.dead_time + SETTLED * about.lag + about.period
        return math.ceil(reach / about.period - 1e-9) + 1

    def around(self, controller: Any) -> Predicting:
        """See Remedy: the controller behind a prediction of its measurements by its own model."""
        settings = getattr(innermost(controller), "settings", None)
        dead_time = self.dead_time
        if dead_time is None:
            dead_time = getattr(settings, "dead_time", 0.0)
        lag = self.motor_lag
        if lag is None:
            lag = getattr(settings, "known_lag", 0.0)
        return Predicting(controller, self, dead_time, lag)


class Predicting(Layer):
    """A controller that is given the state of now, predicted by a model. dead_time, lag: of commands (s)."""

    def __init__(self, wrapped: Controller, part: Prediction, dead_time: float, lag: float) -> None:
        model = getattr(innermost(wrapped), "mpc", None)
        if model is None:
            ahead = dead_time
            residual = no_residual(wrapped.vehicle)
            theta = residual.theta
        else:
            ahead = 0.0  # an MPC predicts the dead time itself
            residual = model.residual
            theta = model.parameters
        observer: Any = next((layer for layer in layers(wrapped) if hasattr(layer, "numbers")), None)
        about = Circumstances(wrapped.control_period, dead_time, lag, ahead=ahead)
        believed = NO_BELIEF if observer is None else observer.numbers
        super().__init__(wrapped, part, about, residual, {"theta": theta}, kept={"believed": believed})
        self.node_times = wrapped.node_times + ahead

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, self._later(window))

    def inside(self, inputs: InputArrays) -> list[Call]:
        """See Layer: the reference of the time at which a command of now begins to act."""
        if self.about.ahead:
            return [python(lambda: inputs.set_reference(self._later(inputs.window)))]
        return []

    def _later(self, window: Window) -> Window:
        """The reference then; states and inputs are asked for then."""
        powers = [self.about.ahead**i / math.factorial(i) for i in range(len(window.position))]

        def later(derivatives: np.ndarray) -> np.ndarray:
            moved = np.zeros_like(derivatives)
            for i in range(len(derivatives)):
                for power, derivative in zip(powers, derivatives[i:], strict=False):
                    moved[i] += power * derivative
            return moved

        return window._replace(position=later(window.position), yaw=later(window.yaw))
