"""An MPC under one setting: the dead time and lag that it plans with, and the stiffness of its grid."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.memory import Memory
from quadexp.compile.symbolic import ca
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, ControlStep, InputArrays, call, copy
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.dead_time import MotorLead
from quadexp.control.wrapped import parameters_of
from quadexp.parts.sensor_spec import SensorSpec
from quadexp.physics.expression import limited, named_function, named_symbols, split
from quadexp.physics.state import ATTITUDE, N_STATE
from quadexp.plugins.auto.ahead import CommandsAhead, prediction_numbers, sent_commands, span_weights
from quadexp.plugins.auto.auto import Auto
from quadexp.plugins.auto.decide import Decision, grids
from quadexp.plugins.auto.settings import DECISION
from quadexp.plugins.auto.sources import speeds_tell
from quadexp.plugins.remedies.delay_line import DelayLine, later_speeds
from quadexp.plugins.remedies.sent_commands import INSTANT


class AutoMPC(Auto):
    """The MPC plans in the world that is assumed; its grid and weights are one of DECISION.grids."""

    judged = "with the stiffest horizon that it may choose"

    def __init__(self, core: PredictiveController, sensor_spec: SensorSpec) -> None:
        core.targets = speeds_tell(core.vehicle, sensor_spec)  # else of next to no weight beside that of the position
        numbers, mpc = core.believed_numbers, core.mpc
        assert core.believed is not None and mpc.disturbance is not None
        self._last = {"push": np.zeros(6), "wind": np.zeros(3), "scale": np.ones(1)}  # assumed the last step
        self._believed = Memory("Believed", worked=self._last)
        self._now = {"push": mpc.disturbance, "wind": numbers[6:9], "scale": numbers[9:10]}
        commands = sent_commands(core.vehicle, core.control_period)
        super().__init__(core, sensor_spec, mpc.residual, {"theta": parameters_of(core), **self._last}, commands)
        self._world, self._grids = core.believed, grids(core.settings)
        core.predictor, core.lead = CommandsAhead(mpc), MotorLead(mpc.limits, core.settings, core.backend)
        self._spacing = self.control_period / DECISION.samples
        longest = DECISION.largest_wait + max(settings.horizon for settings in self._grids)
        self.node_times = self._spacing * np.arange(math.ceil(longest / self._spacing) + 2)
        self._world.rows = self._rows
        of_grids = [{**mpc.weights(settings), "times": settings.reference_times} for settings in self._grids]
        nodes = [settings.node_times for settings in self._grids]
        sizes = tuple((name, value.size) for name, value in of_grids[0].items())
        self._table = {"table": np.stack([np.hstack([*map(np.ravel, each.values())]) for each in of_grids])}
        ahead, sent = core.predictor, len(core.predictor.sent.values)
        tuned = ahead.ahead.tuned("ahead") | {"delivered_ahead": ahead.delivered.tuned, "gain": core.lead.gain}
        tuned |= self._world.times | {name: mpc.step.arguments[name] for name in mpc.weights(core.settings)}
        self._plans(self._table, tuned, mpc_form, self._spacing, sent, ahead.ahead.parts, sizes)
        function = cached_function(core.backend, resampled, *mpc._X.T.shape, mpc._U.shape[1])
        before, worked = self._memory.of_now["decision"][4:5], mpc.memory.of_next  # X, U, guess
        places = {"X": mpc._X, "U": mpc._U, "grids": np.array(nodes), "before": before}
        self._resample = BufferedFunction(function, places | {"after": self._memory.of_next["decision"][4:5]})
        moved = self._resample.results
        self._worked = [(to, of.reshape(-1)) for to, of in zip(worked.values(), moved.values(), strict=True)]
        whole = whole_periods(later_speeds(sensor_spec), self.control_period)
        self._delay_line = DelayLine(N_STATE + 4, whole, self.control_period, core.backend)

    def starts(self, x: np.ndarray, thrust: np.ndarray) -> list[tuple[Memory, dict[str, Any]]]:
        """See Auto."""
        kept = self._delay_line.memory
        seen = np.tile(np.concatenate([x, np.zeros(4)]), kept.now.size // (N_STATE + 4))
        ahead = self._core.predictor
        sent = {"commands": np.tile(thrust, len(ahead.sent.values))}
        begun = [(ahead.memory, sent), (kept, {"kept": seen}), (self._believed, {"scale": np.ones(1)})]
        return [*super().starts(x, thrust), *begun]

    def control_step(self, inputs: InputArrays, state: np.ndarray) -> ControlStep:
        """See control.control_step."""
        made = super().control_step(inputs, state)
        calls = [*made.calls, *(copy(self._last[k], v) for k, v in self._now.items())]
        return made._replace(calls=calls, memory=(*made.memory, self._delay_line.memory, self._believed))

    def _compared(self, inputs: InputArrays, now: np.ndarray) -> tuple[list[Call], dict[str, np.ndarray], np.ndarray]:
        """See Auto. Rotor speeds are compared with the state and reading of their time."""
        if not self._by_speeds:
            return super()._compared(inputs, now)
        seen, delay_line, thrust = np.zeros(N_STATE + 4), self._delay_line, np.zeros(self.vehicle.n_rotors)
        calls = [
            copy(seen[:N_STATE], now),
            copy(seen[N_STATE:-1], inputs.specific_force),
            copy(seen[-1:], inputs.accelerometer_valid),
        ]
        coefficient = self.vehicle.thrust_coefficient or 0.0
        square = Call("square", thrust, inputs.rotor_speed, factor=coefficient, when=inputs.rotor_speed_valid)
        calls += [*delay_line.before(seen), square]
        read = np.zeros(1)
        calls += [copy(read, delay_line.oldest[-1:]), copy(read, inputs.rotor_speed_valid, delay_line.oldest[-1:])]
        then = {
            "x": delay_line.output[:N_STATE],
            "reading": delay_line.output[N_STATE:-1],
            "thrust": thrust,
            "mean": thrust,
        }
        return calls, then, read

    def _retuned(self, when: np.ndarray | None = None) -> list[Call]:
        """See Auto. Where the grid is another one the last solution is moved to its nodes."""
        tune = super()._retuned(when)
        if when is None:
            return tune
        regrids = self._decide.results["regrids"]
        return [*tune, call(self._resample, regrids), *(copy(to, of, regrids) for to, of in self._worked)]


def whole_periods(late: float, period: float) -> float:
    """How much earlier than speeds that are this late the reading is that their thrusts are compared with (s).

    A thrust holds, but for its lag, from one command to the next, and a reading is of the period that it ends.
    """
    return math.floor(late / period + DECISION.next_period) * period


def mpc_form(
    acts: Decision, period: float, spacing: float, sent: int, parts: int, sizes: tuple[tuple[str, int], ...]
) -> tuple[Any, ...]:
    """See plan_function: the dead time in samples of the reference, `spacing` apart (s); what is left of it counts as
    lag, which is inverted, up to the gain 1 / (1 - exp(-T / lag)) = largest_lead on a change of thrust, since more
    would amplify noise, and up to most_inverted. table: of each grid the numbers of these sizes. sent, parts: of what
    predicts over the wait."""
    s = DECISION
    invertible = min(-period / math.log(1 - 1 / s.largest_lead), s.most_inverted)
    waits = acts.dead_time + ca.fmax(acts.lag - invertible, 0)
    waits = spacing * ca.floor(ca.fmin(waits, s.largest_wait) / spacing + 0.5)
    lag = acts.total - waits
    lag = ca.if_else(lag > s.least_lag, lag, 0)
    weights = span_weights(sent, period)
    rest = prediction_numbers("ahead", weights, parts, (0, waits), waits, lag)
    rest["delivered_ahead"] = weights(ca.vertcat(waits, waits, waits, lag))
    rest["gain"] = 1 / (1 - ca.exp(-period / ca.fmax(lag, INSTANT)))
    names, counts = zip(*sizes, strict=True)
    table = ca.MX.sym("table", sum(counts), 1 + len(s.grids))
    chosen = table[ca.DM(range(sum(counts))) + sum(counts) * acts.grid]
    numbers = dict(zip(names, split(chosen, counts), strict=True))
    numbers["times"] = waits + numbers["times"]
    rows, results = ca.floor(numbers["times"] / spacing + 0.5), rest | numbers
    results["since"] = numbers["times"][:: (rows.numel() - 1) // numbers["dt"].numel()]
    return {"table": table}, (acts.dead_time, acts.lag), rows, results


def resampled(width: int, rows: int, inputs: int) -> ca.Function:
    """X (width, N + 1) and U (n, N) of the nodes of one grid at those of another: states between them, of unit
    quaternion, beyond the last one its own; each input is the one that was held at its time. grids: times of the nodes
    (s), a column each. guess: of the active set, zeros."""
    shapes = {"X": (width, rows), "U": (inputs, rows - 1), "grids": (rows, 1 + len(DECISION.grids))}
    a = named_symbols(ca.MX, shapes | {"before": 1, "after": 1})
    before, after = (a["grids"][ca.DM(range(rows)) + rows * a[name]] for name in ("before", "after"))

    def place(times: Any, last: int) -> Any:
        passed = ca.repmat(before.T, times.numel(), 1) < ca.repmat(times, 1, rows)
        return limited(ca.sum2(passed) - 1, 0, last)

    def columns(values: Any, at: Any) -> Any:
        height = values.size1()
        elements = ca.repmat(ca.DM(range(height)), 1, at.numel()) + height * ca.repmat(at.T, height, 1)
        return ca.reshape(values[ca.vec(elements)], height, at.numel())

    at = place(after, rows - 2)
    begins, ends = before[at], before[at + 1]
    share = ca.repmat(limited((after - begins) / (ends - begins), 0, 1).T, width, 1)
    X = (1 - share) * columns(a["X"], at) + share * columns(a["X"], at + 1)
    q = X[ATTITUDE, :]
    X = ca.vertcat(X[: ATTITUDE.start, :], q / ca.repmat(ca.sqrt(ca.sum1(q**2)), 4, 1), X[ATTITUDE.stop :, :])
    U = columns(a["U"], place(after[:-1] + INSTANT, rows - 2))
    return named_function("resampled", a, {"X_new": X, "U_new": U, "guess": ca.DM.zeros(inputs * (rows - 1))})
