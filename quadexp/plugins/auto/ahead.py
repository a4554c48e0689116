"""Where state and thrusts will be or were, by the commands that were sent, over spans that may change in flight.

    late -> now       the given state, over its age
    now -> ahead      the state at which a command of now begins to act, over the dead time

by the model of delay/prediction.py, and the weights of sent_commands.py on the last commands.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, call, copy, run
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.models.residual import Residual
from quadexp.physics.expression import named_function, named_symbols
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.auto.settings import BANK, DECISION
from quadexp.plugins.remedies.delay.prediction import STEP, prediction
from quadexp.plugins.remedies.sent_commands import SETTLED, SentCommands, command_weights


def sent_commands(vehicle: Vehicle, period: float) -> SentCommands:
    """For all that is here. period: of control (s)."""
    reach = BANK.largest_age + DECISION.largest_wait + SETTLED * BANK.largest_lag + period
    return SentCommands(vehicle.n_rotors, period, reach)


def span_weights(count: int, period: float) -> ca.Function:
    """Weights (count,) on the last commands, a period (s) apart, the oldest first, of the mean thrust over a span: its
    begin and end, 0 is now, before the command of now is sent, dead time and lag (s), (4,). A span of no length has the
    thrust at its time."""
    span = ca.MX.sym("span", 4)
    begin, end, dead_time, lag = ca.vertsplit(span)
    weights = command_weights(count, period, (begin, end), dead_time, lag)
    return ca.Function("span_weights", [span], [weights[::-1]])


def prediction_numbers(
    of: str, weights: ca.Function, parts: int, span: tuple[Any, Any], dead_time: Any, lag: Any
) -> dict[str, Any]:
    """What an Ahead is given a span, from now (s), and of what commands wait and lag (s), by `Ahead.tuned`: how long
    each of its parts is, the weights of commands in it, and whether there is any."""
    begin, end = span
    starts = ca.fmin(begin + STEP * ca.DM(range(parts)), end)
    ends = ca.fmin(starts + STEP, end)
    delays = ca.repmat(ca.horzcat(dead_time, lag), parts, 1)
    spans = ca.horzcat(starts, ends, delays).T
    of_parts = weights.map(parts)(spans)
    return {f"{of}_dt": ends - starts, f"{of}_weights": of_parts, f"{of}_moves": end > begin}


class Ahead:
    """The state at the end of a span of time, from that at its beginning.

    model: its vehicle, residual and backend. shared: arrays that the prediction reads, see delay.prediction. longest
    span: (s).
    """

    def __init__(
        self,
        vehicle: Vehicle,
        residual: Residual,
        backend: str,
        commands: SentCommands,
        shared: Mapping[str, np.ndarray],
        longest: float = BANK.largest_age,
    ) -> None:
        self.parts = math.ceil(longest / STEP - 1e-9)
        function = cached_function(backend, prediction, vehicle, residual, self.parts, len(commands.values))
        self._predict = BufferedFunction(function, {"commands": commands.values, **shared})
        self._moves = np.zeros(1)
        given = self._predict.arguments
        if "scale" not in shared:
            given["scale"][0] = 1.0
        if "theta" not in shared:
            given["theta"][...] = residual.theta

    def tuned(self, of: str) -> dict[str, np.ndarray]:
        """Arrays of what it is given a span, see prediction_numbers."""
        given = self._predict.arguments
        return {f"{of}_dt": given["dt"], f"{of}_weights": given["weights"], f"{of}_moves": self._moves}

    def before(self, state: np.ndarray) -> tuple[list[Call], np.ndarray]:
        """Predicts from the state that is found there, (13,), and the array that has that of the end then."""
        end = self._predict.results["now"]
        calls = [copy(self._predict.arguments["x"], state), copy(end, state), call(self._predict, self._moves)]
        return calls, end


def delivered_thrusts(commands: SentCommands, backend: str, spans: int) -> BufferedFunction:
    """The thrusts of the rotors over spans, `thrust`, (s, n) (N), by the commands and their `weights` in each span, the
    oldest first, (s, m); of one span (n,) and (m,)."""
    function = cached_function(backend, weighted, *commands.values.shape, spans)
    return BufferedFunction(function, {"commands": commands.values})


def weighted(count: int, rotors: int, spans: int) -> ca.Function:
    """commands (n, m) (N) and weights (m, s) -> thrust (n, s) (N)."""
    a = named_symbols(ca.MX, {"commands": (rotors, count), "weights": (count, spans)})
    return named_function("weighted", a, {"thrust": a["commands"] @ a["weights"]})


class CommandsAhead:
    """A DeadTimePredictor whose dead time and lag may change in flight; thrusts in N delivered."""

    def __init__(self, mpc: ModelPredictiveController) -> None:
        self.sent = sent_commands(mpc.vehicle, mpc.settings.control_period)
        self.memory = self.sent.memory
        self.memory.owner = "CommandsAhead"  # beside the SentCommands of the controller around
        shared = {"theta": mpc.parameters}
        if mpc.disturbance is not None:
            shared["push"] = mpc.disturbance
        self.ahead = Ahead(mpc.vehicle, mpc.residual, mpc.backend, self.sent, shared, DECISION.largest_wait)
        self.delivered = delivered_thrusts(self.sent, mpc.backend, 1)
        self._full = np.zeros(N_STATE + mpc.vehicle.n_rotors)

    def reset(self, thrust: np.ndarray) -> None:
        """See DeadTimePredictor.reset."""
        self.sent.reset(thrust)

    def predict(self, x: np.ndarray) -> np.ndarray:
        """See DeadTimePredictor.predict."""
        calls, predicted = self.before(x)
        run(calls)
        return predicted.copy()

    def before(self, state: np.ndarray) -> tuple[list[Call], np.ndarray]:
        """See DeadTimePredictor.before; the thrusts stand behind the state, (13 + n,)."""
        calls, now = self.ahead.before(state)
        calls.append(call(self.delivered))
        calls.append(copy(self._full[:N_STATE], now))
        calls.append(copy(self._full[N_STATE:], self.delivered.results["thrust"]))
        return calls, self._full

    def after(self, command: np.ndarray) -> list[Call]:
        """See DeadTimePredictor.after."""
        return self.sent.after(command)
