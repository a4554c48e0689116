"""Where state and thrusts will be or were, by the commands that were sent, over spans that may change in flight.

    late -> now       the told state, over its age
    now -> ahead      the state at which a command of now begins to act, over the dead time

by the model of delay/prediction.py, and the weights of control.delivered on the last commands.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.built import built
from quadexp.control.delivered import SETTLED, SentCommands
from quadexp.control.instant import Operation, call, copy, run
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.models.residual import Residual
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.auto.settings import BANK, DECISION
from quadexp.plugins.remedies.delay.prediction import STEP, prediction


def sent_commands(vehicle: Vehicle, period: float) -> SentCommands:
    """For all that is here. period: of control (s)."""
    reach = BANK.largest_age + DECISION.largest_wait + SETTLED * BANK.largest_lag + period
    return SentCommands(vehicle.n_rotors, period, reach)


class Ahead:
    """The state at the end of a span of time, from that at its beginning.

    model: its vehicle, residual and backend. shared: arrays that the prediction reads, see delay.prediction. longest
    span: (s).
    """

    def __init__(
        self, vehicle: Vehicle, residual: Residual, backend: str, commands: SentCommands,
        shared: Mapping[str, np.ndarray], longest: float = BANK.largest_age,
    ) -> None:  # fmt: skip
        self._commands, self._parts = commands, math.ceil(longest / STEP - 1e-9)
        function = built(backend, prediction, vehicle, residual, self._parts, len(commands.values))
        self._predict = BufferedFunction(function, {"commands": commands.values, **shared})
        self._given, self._moves = self._predict.arguments, np.zeros(1)
        self._x, self._end = self._given["x"], self._predict.results["now"]
        if "scale" not in shared:
            self._given["scale"][0] = 1.0
        if "theta" not in shared:
            self._given["theta"][...] = residual.theta

    def tune(self, begin: float, end: float, dead_time: float, lag: float) -> None:
        """Another span, from now (s), and what commands wait and lag (s)."""
        self._moves[0] = end > begin
        if end <= begin:
            return
        starts = np.minimum(begin + np.arange(self._parts) * STEP, end)
        ends = np.minimum(starts + STEP, end)
        self._given["dt"][:] = ends - starts
        weights = self._commands.weights(np.stack([starts, ends], axis=1), dead_time, lag)
        self._given["weights"].reshape(weights.shape)[...] = weights

    def before(self, state: np.ndarray) -> tuple[list[Operation], np.ndarray]:
        """Predicts from the state that is found there, (13,), and the array that has that of the end then."""
        return [copy(self._x, state), copy(self._end, state), call(self._predict, self._moves)], self._end


class Delivered:
    """The thrusts of the rotors over a span, (n,) (N), by the commands. thrust: where they are then."""

    def __init__(self, commands: SentCommands, backend: str) -> None:
        self._commands, shape = commands, commands.values.shape
        self._weigh = BufferedFunction(built(backend, weighted, *shape), {"commands": commands.values})
        self.thrust = self._weigh.results["thrust"]

    def tune(self, begin: float, end: float, dead_time: float, lag: float) -> None:
        """The span, from now (s), an instant where it has no length, and what commands wait and lag (s)."""
        self._weigh.arguments["weights"][...] = self._commands.weights(np.array([[begin, end]]), dead_time, lag)[0]

    def before(self) -> list[Operation]:
        """Leaves `thrust`."""
        return [call(self._weigh)]


class CommandedThrust:
    """Thrusts now and over the last period by the commands alone, (n,) each (N), whose delays may change in flight."""

    def __init__(self, commands: SentCommands, period: float, backend: str) -> None:
        self._now, self._mean, self._period = Delivered(commands, backend), Delivered(commands, backend), period
        self.thrust, self.mean = self._now.thrust, self._mean.thrust

    def tune(self, dead_time: float, lag: float) -> None:
        """What commands wait and lag from now on (s)."""
        self._now.tune(0.0, 0.0, dead_time, lag)
        self._mean.tune(-self._period, 0.0, dead_time, lag)

    def before(self) -> list[Operation]:
        """Leaves `thrust` and `mean`."""
        return [*self._now.before(), *self._mean.before()]


def weighted(count: int, rotors: int) -> ca.Function:
    """commands (n, m) (N) and weights (m,) -> thrust (n,) (N)."""
    commands, weights = ca.MX.sym("commands", rotors, count), ca.MX.sym("weights", count)
    return ca.Function("weighted", [commands, weights], [commands @ weights], ["commands", "weights"], ["thrust"])


class CommandsAhead:
    """A DeadTimePredictor whose dead time and lag may change in flight; thrusts in N delivered."""

    def __init__(self, mpc: ModelPredictiveController) -> None:
        self._sent = sent_commands(mpc.vehicle, mpc.settings.control_period)
        self.memory = self._sent.memory
        shared = {"theta": mpc.parameters} | ({} if mpc.disturbance is None else {"push": mpc.disturbance})
        self._ahead = Ahead(mpc.vehicle, mpc.residual, mpc.backend, self._sent, shared, DECISION.largest_wait)
        self._delivered = Delivered(self._sent, mpc.backend)
        self._full = np.zeros(N_STATE + mpc.vehicle.n_rotors)
        self.tune(0.0, 0.0, self._sent.values)

    def tune(self, dead_time: float, lag: float, commands: np.ndarray) -> None:
        """Dead time and lag (s) from now on, and what was delivered of the commands before, (k, n) (N), the oldest
        first."""
        self._sent.values[...] = commands[-len(self._sent.values) :]
        self.memory.commit()
        self._ahead.tune(0.0, dead_time, dead_time, lag)
        self._delivered.tune(dead_time, dead_time, dead_time, lag)

    def reset(self, thrust: np.ndarray) -> None:
        """See DeadTimePredictor.reset."""
        self._sent.reset(thrust)

    def predict(self, x: np.ndarray) -> np.ndarray:
        """See DeadTimePredictor.predict."""
        operations, predicted = self.before(x)
        run(operations)
        return predicted.copy()

    def before(self, state: np.ndarray) -> tuple[list[Operation], np.ndarray]:
        """See DeadTimePredictor.before; the thrusts stand behind the state, (13 + n,)."""
        operations, now = self._ahead.before(state)
        operations += self._delivered.before()
        operations += [copy(self._full[:N_STATE], now), copy(self._full[N_STATE:], self._delivered.thrust)]
        return operations, self._full

    def after(self, command: np.ndarray) -> list[Operation]:
        """See DeadTimePredictor.after."""
        return self._sent.after(command)
