"""The thrust that the rotors deliver, as far as a controller can know it.

Where rotor speeds W are measured and the vehicle's thrust coefficient is stated, it is c_t W^2. Otherwise it follows
from the commands: one that was sent at t_j acts over [t_j + d, t_j + d + T], d the dead time and T the control period,
and the thrust follows it with a first-order lag (physics.motor).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np

from quadexp.compile.backend import BufferedFunction, realise
from quadexp.compile.symbolic import ca
from quadexp.control.base import Measurement
from quadexp.control.instant import Operation, call, copy, move
from quadexp.physics.expression import Expression
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
    function = BufferedFunction(_commands_function(rotors, delays.pending, backend), shared)
    function.arguments["numbers"][...] = delays.numbers
    return function


@cache
def _commands_function(rotors: int, pending: int, backend: str) -> ca.Function:
    shapes = {"commands": (rotors, pending), "thrust": (rotors, 1), "sent": (rotors, 1), "numbers": (6, 1)}
    a = {name: ca.SX.sym(name, *shape) for name, shape in shapes.items()}
    names = ["commands_next", "thrust_next", "mean"]
    function = ca.Function("delivered", [*a.values()], [*delivered_by_commands(*a.values())], [*a], names)
    return realise(function, backend)


class DeliveredThrust:
    """Call `reset`, then at every control instant `now` and `record`, in this order, also where speeds are measured.

    dead_time, lag: what is known of the commands' delay and of the rotors' time constant (s).
    thrust: by the commands, at the control instant, (n,) (N). mean: the same over the last control period; where rotor
    speeds are measured, and lag is not 0, of the measured thrusts at its two ends.
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
        self._commands, self.thrust, self._sent = given["commands"], given["thrust"], given["sent"]
        self.mean = self._next["mean"]
        self._measured, self._before = np.zeros((2, vehicle.n_rotors))
        self._turning = False  # whether `_before` was measured

    def reset(self, thrust: np.ndarray) -> None:
        """Start a flight: this command, (n,) (N), has been sent for a long time."""
        self._commands[...] = self.thrust[...] = self.mean[...] = thrust
        self._turning = False

    def now(self, measurement: Measurement) -> np.ndarray:
        """Thrusts at the control instant, just before the new command, (n,) (N)."""
        if measurement.rotor_speed is None or self._coefficient is None:
            self._turning = False
            return self.thrust
        self._measured[...] = self._coefficient * measurement.rotor_speed**2
        both = self._lag and self._turning
        self.mean[...] = (self._before + self._measured) / 2 if both else self._measured
        self._before[...], self._turning = self._measured, True
        return self._measured

    def record(self, command: np.ndarray) -> None:
        """Add the command, (n,) (N), that was sent at this control instant, and go on by one control period."""
        self._sent[...] = command
        self._on()
        self.thrust[...] = self._next["thrust_next"]
        self._commands[...] = self._next["commands_next"]

    def before(self, speed: np.ndarray | None) -> tuple[list[Operation], np.ndarray]:
        """`now` for C, and the array that has the thrusts then. speed: where rotor speeds are found; None: they are not
        measured."""
        if speed is None or self._coefficient is None:
            return [], self.thrust
        now = [Operation("square", self._measured, speed, factor=self._coefficient)]
        if self._lag:
            now.append(Operation("mean", self.mean, self._before, self._measured))
        else:
            now.append(copy(self.mean, self._measured))
        return [*now, move(self._before, self._measured)], self._measured

    def after(self, command: np.ndarray) -> list[Operation]:
        """`record` for C, of the command that is found there."""
        results = [copy(self.thrust, self._next["thrust_next"]), copy(self._commands, self._next["commands_next"])]
        return [copy(self._sent, command), call(self._on), *results]

    def ready(self, speed: np.ndarray | None) -> bool:
        """Whether these operations hold: what they need of the period before was measured."""
        return self._turning or speed is None or self._coefficient is None
