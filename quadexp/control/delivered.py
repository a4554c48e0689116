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
from quadexp.compile.memory import Memory, connected, sizes_of
from quadexp.compile.symbolic import ca
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, InputArrays, call, copy
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


def delivered_thrust(
    kept: Mapping[str, Any], sent: Any, numbers: Any, measured: Any = None, turning: Any = 0
) -> tuple[Any, Any, dict[str, Any]]:
    """Thrusts now and their mean over the last control period, (n,) each (N), and of `kept` the next values; symbols.

    kept: commands, that are pending, (n K,); thrust, by commands, (n,); before, thrusts as they were measured a period
    ago and whether they were, (n + 1,). sent: the command of a period ago, (n,). numbers: of Delays. measured: thrusts
    by rotor speeds, (n,); None: never. turning: whether they are measured now. The mean of measured thrusts is that
    of the two ends where the rotors lag.
    """
    n = sent.numel()
    commands = ca.reshape(kept["commands"], n, kept["commands"].numel() // n)
    commands, thrust, mean = delivered_by_commands(commands, kept["thrust"], sent, numbers)
    next_values = {"commands": ca.vec(commands), "thrust": thrust}
    if measured is None:
        return thrust, mean, next_values
    before, had = kept["before"][:n], kept["before"][n]
    now = turning * measured + (1 - turning) * thrust
    share = turning * had * numbers[-1] / 2  # of the thrusts a period ago
    mean = turning * (share * before + (1 - share) * measured) + (1 - turning) * mean
    return now, mean, next_values | {"before": ca.vertcat(measured, turning)}


class DeliveredThrust:
    """`delivered_thrust` as calls `before` and `after` those of a controller; `reset` begins a flight.

    thrust, mean: see there. memory: what is remembered, a part of the instant's.
    """

    def __init__(
        self, vehicle: Vehicle, period: float, dead_time: float = 0.0, lag: float = 0.0, *, backend: str = "interpreted"
    ) -> None:
        delays = Delays(period, dead_time, lag)
        self._function, self._pending = cached_function(backend, _delivered_function, vehicle, delays), delays.pending
        self.memory = Memory("DeliveredThrust", sizes_of([self._function]) | {"sent": vehicle.n_rotors})
        self.thrust, self.mean = np.zeros((2, vehicle.n_rotors))

    def reset(self, thrust: np.ndarray) -> None:
        """Start a flight: this command, (n,) (N), has been sent for a long time."""
        self.memory.begin({"commands": np.tile(thrust, self._pending), "thrust": thrust, "sent": thrust})

    def before(self, inputs: InputArrays) -> list[Call]:
        """Leaves `thrust` and `mean`."""
        places = {"speed": inputs.rotor_speed, "turning": inputs.rotor_speed_valid}
        results = {"thrust": self.thrust, "mean": self.mean}
        return [call(connected(self._function, places, results, self.memory))]

    def after(self, command: np.ndarray) -> list[Call]:
        """Remembers the command that is found there, (n,) (N)."""
        return [copy(self.memory.of_next["sent"], command)]


def _delivered_function(vehicle: Vehicle, delays: Delays) -> ca.Function:
    n, coefficient = vehicle.n_rotors, vehicle.thrust_coefficient
    a = named_symbols(ca.SX, {f"memory_{name}": size for name, size in kept_sizes(n, delays).items()})
    speeds = {} if coefficient is None else named_symbols(ca.SX, {"speed": n, "turning": 1})
    measured = [coefficient * speeds["speed"] ** 2, speeds["turning"]] if speeds else []
    kept = {name.removeprefix("memory_"): value for name, value in a.items()}
    thrust, mean, next_values = delivered_thrust(kept, kept["sent"], ca.DM(delays.numbers), *measured)
    results = {"thrust": thrust, "mean": mean} | {f"next_{name}": value for name, value in next_values.items()}
    return named_function("delivered", a | speeds, results)


def kept_sizes(rotors: int, delays: Delays) -> dict[str, int]:
    """Numbers of what `delivered_thrust` keeps, and of `sent`."""
    return {"commands": rotors * delays.pending, "thrust": rotors, "before": rotors + 1, "sent": rotors}


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
        self.memory = Memory("SentCommands", worked={"commands": self.values})
        flat = self.values.reshape(-1)
        self._older, self._newer, self._newest = flat[:-rotors], flat[rotors:], flat[-rotors:]

    def reset(self, thrust: np.ndarray) -> None:
        """Begin a flight: this command, (n,) (N), has been sent for a long time."""
        self.values[...] = thrust
        self.memory.commit()

    def after(self, command: np.ndarray) -> list[Call]:
        """Adds the command that is found there, (n,) (N), and goes on by one control period."""
        return [copy(self._older, self._newer), copy(self._newest, command)]

    def weights(self, spans: np.ndarray, dead_time: float, lag: float) -> np.ndarray:
        """Weights (s, m) on the commands of the mean thrusts over spans (s, 2) (s): beginning and end, 0 is now, before
        the command of now is sent. A span of no length has the thrust at its time."""
        if len(spans) not in self._weigh:
            self._weigh[len(spans)] = BufferedFunction(weights_function(len(self.values), self._period, len(spans)))
        function = self._weigh[len(spans)]
        arguments, weights = function.arguments, function.results["weights"]
        arguments["spans"][...] = np.where(np.diff(spans) > INSTANT, spans, spans[:, 1:] + [-INSTANT, 0.0])
        arguments["delays"][...] = dead_time, lag
        function()
        return weights.reshape(len(spans), -1)[:, ::-1].copy()


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
    each = [command_weights(count, period, ca.vertsplit(column), delays[0], delays[1]) for column in ca.horzsplit(span)]
    return ca.Function("weights", [span, delays], [ca.horzcat(*each)], ["spans", "delays"], ["weights"])
