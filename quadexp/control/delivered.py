"""The thrust that the rotors deliver, as far as a controller can know it.

Where rotor speeds W are measured and the vehicle's thrust coefficient is stated, it is c_t W^2. Otherwise it follows
from the commands: one that was sent at t_j acts over [t_j + d, t_j + d + T], d the dead time and T the control period,
and the thrust follows it with a first-order lag (physics.motor). So it is linear in the commands, and its mean over a
span [a, b] is

    sum_j u_j (S(s_j) - S(s_{j+1})) / (b - a),    s_j = t_j + d,    S(s) = G(b - s) - G(a - s)
    G(x) = x - lag (1 - exp(-x / lag)) for x > 0, else 0            integral of the step response

The oldest command that is kept counts as having been sent for ever: S(s_0) = b - a.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.built import built
from quadexp.control.instant import Operation, Told, call, copy, move
from quadexp.physics.expression import Expression, named_function, named_symbols, symbols
from quadexp.physics.motor import decayed
from quadexp.physics.vehicle import Vehicle


@dataclass(frozen=True)
class Delays:
    """What is known of the commands' way to thrust: control period, dead time, lag of the rotors (s)."""

    period: float
    dead_time: float
    lag: float

    @property
    def pending(self) -> int:
        """Commands that have been sent and have not acted for their whole period."""
        return max(math.ceil(self.dead_time / self.period - 1e-9), 0)

    @property
    def durations(self) -> tuple[float, float]:
        """For how long the oldest pending command, and the next one, act in a control period (s)."""
        first = self.dead_time - (self.pending - 1) * self.period
        return (first, self.period - first) if self.pending else (self.period, 0.0)

    @property
    def numbers(self) -> np.ndarray:
        """For `delivered_by_commands`: the durations' shares of the period, the decays over them, the lag in periods,
        and whether there is a lag."""
        decays = [math.exp(-d / self.lag) if self.lag else float(not d) for d in self.durations]
        shares = [d / self.period for d in self.durations]
        return np.array([*shares, *decays, self.lag / self.period, float(self.lag > 0)])


def delivered_by_commands(
    commands: Expression, thrust: Expression, sent: Expression, numbers: Expression
) -> tuple[Expression, Expression, Expression]:
    """One control period: pending commands (n, K) and thrust (n,) after it, and the mean thrust over it (N).

    commands, thrust: before it. sent: the command that was sent at its beginning, (n,) (N). numbers: of Delays.
    """
    acting = ca.horzcat(commands, sent)
    first, mean = thrust, 0
    for i in range(min(acting.size2(), 2)):
        u = acting[:, i]
        after = decayed(thrust, u, numbers[2 + i])
        mean, thrust = mean + numbers[i] * u, after
    return acting[:, 1:], thrust, mean + numbers[4] * (first - thrust)


def commands_function(
    rotors: int, delays: Delays, backend: str, shared: Mapping[str, np.ndarray] | None = None
) -> BufferedFunction:
    """`delivered_by_commands` as a function of commands, thrust and sent: commands_next, thrust_next, mean.

    backend: resolved. shared: see BufferedFunction."""
    function = BufferedFunction(built(backend, _commands_function, rotors, delays.pending), shared)
    function.arguments["numbers"][...] = delays.numbers
    return function


def _commands_function(rotors: int, pending: int) -> ca.Function:
    shapes = {"commands": (rotors, pending), "thrust": rotors, "sent": rotors, "numbers": 6}
    a = named_symbols(ca.SX, shapes)
    commands, thrust, mean = delivered_by_commands(*a.values())
    return named_function("delivered", a, {"commands_next": commands, "thrust_next": thrust, "mean": mean})


class DeliveredThrust:
    """Its operations stand `before` and `after` the controller's, at every control instant; `reset` begins a flight.

    dead_time, lag: what is known of the commands' delay and of the rotors' time constant (s).
    thrust: at the control instant, just before the new command, (n,) (N). mean: over the last control period; where
    rotor speeds are measured, and lag is not 0, of the measured thrusts at its two ends.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        control_period: float,
        dead_time: float = 0.0,
        lag: float = 0.0,
        *,
        backend: str = "interpreted",
    ) -> None:
        self._coefficient, self._lag = vehicle.thrust_coefficient, lag
        self._on = commands_function(vehicle.n_rotors, Delays(control_period, dead_time, lag), backend)
        given, self._next = self._on.arguments, self._on.results
        self._commands, self._by_commands, self._sent = given["commands"], given["thrust"], given["sent"]
        self.mean, self.thrust = self._next["mean"], self._by_commands
        if self._coefficient is not None:
            self.thrust, self._before = np.zeros((2, vehicle.n_rotors))
            self._turned, self._both = np.zeros((2, 1))  # whether `before` was measured, and thrust is too

    def reset(self, thrust: np.ndarray) -> None:
        """Start a flight: this command, (n,) (N), has been sent for a long time."""
        self._commands[...] = self._by_commands[...] = self.mean[...] = thrust
        if self._coefficient is not None:
            self._turned[...] = 0.0

    def before(self, told: Told) -> list[Operation]:
        """Leaves `thrust` and `mean`."""
        if self._coefficient is None:
            return []
        square = Operation("square", self.thrust, told.speed, factor=self._coefficient, when=told.turning)
        now = [copy(self.thrust, self._by_commands), square, copy(self.mean, self.thrust, told.turning)]
        if self._lag:
            now += [copy(self._both, self._turned), copy(self._both, told.turning, self._turned)]
            now.append(Operation("mix", self.mean, self._before, self.thrust, factor=0.5, when=self._both))
        return [*now, move(self._before, self.thrust, told.turning), move(self._turned, told.turning)]

    def after(self, command: np.ndarray) -> list[Operation]:
        """Goes on by one control period under the command that is found there, (n,) (N)."""
        thrust, commands = self._next["thrust_next"], self._next["commands_next"]
        return [
            copy(self._sent, command),
            call(self._on),
            copy(self._by_commands, thrust),
            copy(self._commands, commands),
        ]


SETTLED = 6.0  # time constants, after which nothing of a lag is left
INSTANT = 1e-9  # s, a span that counts as an instant
NO_LAG = 1e-18  # s


class SentCommands:
    """The last commands, (m, n) (N), the oldest first; `reset` begins a flight.

    reach: how far back spans may begin (s), dead time and lags included.
    """

    def __init__(self, rotors: int, period: float, reach: float) -> None:
        self._period = period
        self.values = np.zeros((math.ceil(reach / period - 1e-9) + 1, rotors))
        self._weigh: dict[int, BufferedFunction] = {}  # by the number of spans; their buffers are this object's alone
        flat = self.values.reshape(-1)
        self._older, self._newer, self._newest = flat[:-rotors], flat[rotors:], flat[-rotors:]

    def reset(self, thrust: np.ndarray) -> None:
        """Begin a flight: this command, (n,) (N), has been sent for a long time."""
        self.values[...] = thrust

    def after(self, command: np.ndarray) -> list[Operation]:
        """Adds the command that is found there, (n,) (N), and goes on by one control period."""
        return [copy(self._older, self._newer), copy(self._newest, command)]

    def weights(self, spans: np.ndarray, dead_time: float, lag: float) -> np.ndarray:
        """Weights (s, m) on the commands of the mean thrusts over spans (s, 2) (s): beginning and end, 0 is now, before
        the command of now is sent. A span of no length has the thrust at its time."""
        if len(spans) not in self._weigh:
            self._weigh[len(spans)] = BufferedFunction(weights_function(len(self.values), self._period, len(spans)))
        function = self._weigh[len(spans)]
        given, found = function.arguments, function.results["weights"]
        given["spans"][...] = np.where(np.diff(spans) > INSTANT, spans, spans[:, 1:] + [-INSTANT, 0.0])
        given["delays"][...] = dead_time, lag
        function()
        return found.reshape(len(spans), -1)[:, ::-1].copy()


def command_weights(count: int, period: float, span: Any, dead_time: Any, lag: Any) -> Any:
    """Weights (m,) on m = count commands, a control period (s) apart, the newest first, of the mean thrust over a span
    (begin, end) (s); symbols."""
    acts = dead_time - period * ca.DM(np.arange(1.0, count + 1))  # s_j
    tau = ca.fmax(lag, NO_LAG)

    def integral(x: Any) -> Any:
        """Of the step response over x (s) since the step."""
        x = ca.fmax(x, 0)
        return x + tau * ca.expm1(-x / tau)

    passed = (integral(span[1] - acts) - integral(span[0] - acts)) / (span[1] - span[0])
    passed = ca.vertcat(passed[:-1], 1)
    return passed - ca.vertcat(0, passed[:-1])


@lru_cache(maxsize=32)
def weights_function(count: int, period: float, spans: int) -> ca.Function:
    """`command_weights` of so many spans at once: spans (2, k), delays: dead time and lag -> weights (m, k)."""
    span, delays = symbols(ca.SX, spans=(2, spans), delays=2)
    each = [command_weights(count, period, ca.vertsplit(one), delays[0], delays[1]) for one in ca.horzsplit(span)]
    return ca.Function("weights", [span, delays], [ca.horzcat(*each)], ["spans", "delays"], ["weights"])
