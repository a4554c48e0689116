"""The last commands, kept for what is around a controller, and the thrust that the rotors deliver of them.

A command that was sent at t_j acts over [t_j + d, t_j + d + T], d the dead time and T the control period, and the
thrust follows it with a first-order lag (physics.motor). So it is linear in the commands, and its mean over a span
[a, b] is

    sum_j u_j (S(s_j) - S(s_{j+1})) / (b - a),    s_j = t_j + d,    S(s) = G(b - s) - G(a - s)
    G(x) = x - lag (1 - exp(-x / lag)) for x > 0, else 0            integral of the step response

The oldest command that is kept counts as having been sent for ever: S(s_0) = b - a.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.memory import Memory, connected, sizes_of
from quadexp.compile.symbolic import ca
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, InputArrays, call, copy
from quadexp.control.delivered import Delays, delivered_thrust, kept_sizes
from quadexp.physics.expression import named_function, named_symbols, symbols
from quadexp.physics.vehicle import Vehicle

SETTLED = 6.0  # time constants, after which nothing of a lag is left
INSTANT = 1e-6  # s, a span that counts as an instant: more than the rounding of times in single precision
NO_LAG = 1e-18  # s


class DeliveredThrust:
    """`delivered_thrust` as calls `before` and `after` those of a controller; `reset` begins a flight.

    thrust, mean: see there. memory: what is remembered, a part of the instant's.
    """

    def __init__(self, vehicle: Vehicle, period: float, dead_time: float = 0.0, lag: float = 0.0) -> None:
        delays = Delays(period, dead_time, lag)
        self._function = cached_function("interpreted", _delivered_function, vehicle, delays)
        self._pending = delays.pending
        self.memory = Memory("DeliveredThrust", sizes_of([self._function]) | {"sent": vehicle.n_rotors})
        self.thrust, self.mean = np.zeros((2, vehicle.n_rotors))

    def reset(self, thrust: np.ndarray) -> None:
        """Start a flight: this command, (n,) (N), has been sent for a long time."""
        self.memory.begin({"commands": np.tile(thrust, self._pending), "thrust": thrust, "sent": thrust})

    def before(self, inputs: InputArrays) -> list[Call]:
        """Leaves `thrust` and `mean`."""
        places = {"speed": inputs.rotor_speed, "turning": inputs.rotor_speed_valid}
        results = {"thrust": self.thrust, "mean": self.mean}
        transition = connected(self._function, places, results, self.memory)
        return [call(transition)]

    def after(self, command: np.ndarray) -> list[Call]:
        """Remembers the command that is found there, (n,) (N)."""
        return [copy(self.memory.of_next["sent"], command)]


def _delivered_function(vehicle: Vehicle, delays: Delays) -> ca.Function:
    n = vehicle.n_rotors
    coefficient = vehicle.thrust_coefficient
    sizes = kept_sizes(n, delays)
    a = named_symbols(ca.SX, {f"memory_{name}": size for name, size in sizes.items()})
    kept = {name: a[f"memory_{name}"] for name in sizes}
    measured = []
    if coefficient is not None:
        speeds = named_symbols(ca.SX, {"speed": n, "turning": 1})
        measured = [coefficient * speeds["speed"] ** 2, speeds["turning"]]
        a |= speeds
    thrust, mean, next_values = delivered_thrust(kept, kept["sent"], ca.DM(delays.numbers), *measured)
    results = {"thrust": thrust, "mean": mean} | {f"next_{name}": value for name, value in next_values.items()}
    return named_function("delivered", a, results)


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
        self._older = flat[:-rotors]
        self._newer = flat[rotors:]
        self._newest = flat[-rotors:]

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
        count = len(spans)
        function = self._weigh.get(count)
        if function is None:
            function = BufferedFunction(weights_function(len(self.values), self._period, count))
            self._weigh[count] = function
        function.arguments["spans"][...] = spans
        function.arguments["delays"][...] = dead_time, lag
        function()
        weights = function.results["weights"].reshape(count, -1)
        return weights[:, ::-1].copy()


def command_weights(count: int, period: float, span: Any, dead_time: Any, lag: Any) -> Any:
    """Weights (m,) on m = count commands, a control period (s) apart, the newest first, of the mean thrust over a span
    (begin, end) (s), or of the thrust at its end where that is an instant; symbols."""
    acts = dead_time - period * ca.DM(np.arange(1.0, count + 1))  # s_j
    tau = ca.fmax(lag, NO_LAG)

    def integral(x: Any) -> Any:
        """Of the step response over x (s) since the step."""
        x = ca.fmax(x, 0)
        return x + tau * ca.expm1(-x / tau)

    begin, end = span
    since = end - acts
    mean = (integral(since) - integral(begin - acts)) / (end - begin)
    at_end = ca.if_else(since > INSTANT, -ca.expm1(-since / tau), 0)  # what begins at this instant has not acted yet
    passed = ca.if_else(end - begin > INSTANT, mean, at_end)
    passed = ca.vertcat(passed[:-1], 1)
    return passed - ca.vertcat(0, passed[:-1])


@lru_cache(maxsize=32)
def weights_function(count: int, period: float, spans: int) -> ca.Function:
    """`command_weights` of so many spans at once: spans (2, k), delays: dead time and lag -> weights (m, k)."""
    span, delays = symbols(ca.SX, spans=(2, spans), delays=2)
    dead_time, lag = ca.vertsplit(delays)
    weights = []
    for column in ca.horzsplit(span):
        weights.append(command_weights(count, period, ca.vertsplit(column), dead_time, lag))
    return ca.Function("weights", [span, delays], [ca.horzcat(*weights)], ["spans", "delays"], ["weights"])
