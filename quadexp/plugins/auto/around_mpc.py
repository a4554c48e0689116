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
from quadexp.names import named
from quadexp.parts.sensor_spec import SensorSpec
from quadexp.physics.expression import limited, named_function, named_symbols, split
from quadexp.physics.state import ATTITUDE, N_STATE
from quadexp.plugins.auto.ahead import CommandsAhead, prediction_numbers, span_weights
from quadexp.plugins.auto.auto import Auto
from quadexp.plugins.auto.decide import Decision, grids
from quadexp.plugins.auto.settings import DECISION
from quadexp.plugins.auto.sources import speeds_tell
from quadexp.plugins.remedies.delay_line import DelayLine, later_speeds
from quadexp.plugins.remedies.sent_commands import INSTANT

GRID = slice(4, 5)  # of a Decision


class AutoMPC(Auto):
    """The MPC plans in the world that is assumed; its grid and weights are one of DECISION.grids."""

    settles = "with the stiffest horizon that it may choose"

    def __init__(self, core: PredictiveController, sensor_spec: SensorSpec) -> None:
        core.targets = speeds_tell(core.vehicle, sensor_spec)  # else of next to no weight beside that of the position
        super().__init__(core, sensor_spec, core.mpc.residual, parameters_of(core))
        mpc, backend = core.mpc, core.backend
        assert core.believed is not None and mpc.disturbance is not None
        wind, scale = core.believed_numbers[6:9], core.believed_numbers[9:10]
        self._now = {"push": mpc.disturbance, "wind": wind, "scale": scale}
        self._ahead = core.predictor = CommandsAhead(mpc)
        core.lead = MotorLead(mpc.limits, core.settings, backend)
        self._grids = grids(core.settings)
        spacing = self.control_period / DECISION.samples
        longest = max(settings.horizon for settings in self._grids)
        longest += DECISION.largest_wait
        self.node_times = spacing * np.arange(math.ceil(longest / spacing) + 2)
        core.believed.rows = self._rows

        table = []
        for settings in self._grids:
            weights = mpc.weights(settings)
            numbers = weights | {"times": settings.reference_times}
            table.append(np.hstack([np.ravel(value) for value in numbers.values()]))
        sizes = tuple((name, value.size) for name, value in numbers.items())
        ahead = self._ahead.ahead
        tuned = ahead.tuned("ahead") | core.believed.times
        tuned |= {"delivered_ahead": self._ahead.delivered.arguments["weights"], "gain": core.lead.gain}
        tuned |= {name: mpc.step.arguments[name] for name in weights}
        sent = len(self._ahead.sent.values)
        self._plans({"table": np.stack(table)}, tuned, mpc_form, spacing, sent, ahead.parts, sizes)

        # where the grid is another one the last solution is moved to its nodes
        nodes = np.array([settings.node_times for settings in self._grids])
        function = cached_function(backend, resampled, *mpc._X.T.shape, mpc._U.shape[1])
        last, decision = self._memory.of_now["decision"], self._memory.of_next["decision"]
        places = {"X": mpc._X, "U": mpc._U, "grids": nodes, "before": last[GRID], "after": decision[GRID]}
        self._resample = BufferedFunction(function, places)
        solution = mpc.memory.of_next.values()  # X, U, guess
        moved = map(np.ravel, self._resample.results.values())
        self._resampled = list(zip(solution, moved, strict=True))
        whole = whole_periods(later_speeds(sensor_spec), self.control_period)
        self._delay_line = DelayLine(N_STATE + 4, whole, self.control_period, backend)

    def starts(self, x: np.ndarray, thrust: np.ndarray) -> list[tuple[Memory, dict[str, Any]]]:
        """See Auto."""
        sent = np.tile(thrust, len(self._ahead.sent.values))
        delay_line = self._delay_line.memory
        seen = np.concatenate([x, np.zeros(4)])
        kept = np.tile(seen, delay_line.now.size // len(seen))
        starts = super().starts(x, thrust)
        starts.append((self._ahead.memory, {"commands": sent}))
        starts.append((delay_line, {"kept": kept}))
        return starts

    def control_step(self, inputs: InputArrays, state: np.ndarray) -> ControlStep:
        """See control.control_step."""
        step = super().control_step(inputs, state)
        row = np.array([float(round(DECISION.ahead / self.node_times[1]))])
        looks = Call("window", self._path[None], row, np.zeros((0, self.vehicle.n_rotors)))
        calls = [looks, *step.calls] + [copy(self._world[name], values) for name, values in self._now.items()]
        return step._replace(calls=calls, memory=(*step.memory, self._delay_line.memory))

    def _compared(self, inputs: InputArrays, now: np.ndarray) -> tuple[list[Call], dict[str, np.ndarray], np.ndarray]:
        """See Auto. Rotor speeds are compared with the state and reading of their time."""
        if not self._by_speeds:
            return super()._compared(inputs, now)
        seen, read = np.zeros(N_STATE + 4), np.zeros(1)
        thrust = np.zeros(self.vehicle.n_rotors)
        then, oldest = self._delay_line.output, self._delay_line.oldest
        coefficient = self.vehicle.thrust_coefficient or 0.0
        calls = [
            copy(seen[:N_STATE], now),
            copy(seen[N_STATE:-1], inputs.specific_force),
            copy(seen[-1:], inputs.accelerometer_valid),
            *self._delay_line.before(seen),
            Call("square", thrust, inputs.rotor_speed, factor=coefficient, when=inputs.rotor_speed_valid),
            copy(read, oldest[-1:]),
            copy(read, inputs.rotor_speed_valid, oldest[-1:]),
        ]
        of_one_time = {"x": then[:N_STATE], "reading": then[N_STATE:-1], "thrust": thrust, "mean": thrust}
        return calls, of_one_time, read

    def _retuned(self, when: np.ndarray | None = None) -> list[Call]:
        """See Auto. Where the grid is another one the last solution is moved to its nodes."""
        calls = super()._retuned(when)
        if when is not None:
            regrids = self._decide.results["regrids"]
            calls.append(call(self._resample, regrids))
            calls += [copy(to, of, regrids) for to, of in self._resampled]
        return calls


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
    left = ca.exp(-period / ca.fmax(lag, INSTANT))
    rest["gain"] = 1 / (1 - left)
    names, counts = zip(*sizes, strict=True)
    height = sum(counts)
    table = ca.MX.sym("table", height, 1 + len(s.grids))
    chosen = table[ca.DM(range(height)) + height * acts.grid]
    numbers = named(names, split(chosen, counts))
    times = numbers["times"] = waits + numbers["times"]
    every = (times.numel() - 1) // numbers["dt"].numel()
    rows = ca.floor(times / spacing + 0.5)
    rest |= numbers
    rest["since"] = times[::every]
    return {"table": table}, (acts.dead_time, acts.lag), rows, rest


def resampled(width: int, rows: int, inputs: int) -> ca.Function:
    """X (width, N + 1) and U (n, N) of the nodes of one grid at those of another: states between them, of unit
    quaternion, beyond the last one its own; each input is the one that was held at its time. grids: times of the nodes
    (s), a column each. guess: of the active set, zeros."""
    shapes = {"X": (width, rows), "U": (inputs, rows - 1)}
    shapes |= {"grids": (rows, 1 + len(DECISION.grids)), "before": (1, 1), "after": (1, 1)}
    a = named_symbols(ca.MX, shapes)
    before = a["grids"][ca.DM(range(rows)) + rows * a["before"]]
    after = a["grids"][ca.DM(range(rows)) + rows * a["after"]]

    def place(times: Any) -> Any:
        nodes = ca.repmat(before.T, times.numel(), 1)
        passed = ca.sum2(nodes < ca.repmat(times, 1, rows))
        return limited(passed - 1, 0, rows - 2)

    def columns(values: Any, at: Any) -> Any:
        height = values.size1()
        inside = ca.repmat(ca.DM(range(height)), 1, at.numel())
        elements = inside + height * ca.repmat(at.T, height, 1)
        return ca.reshape(values[ca.vec(elements)], height, at.numel())

    at = place(after)
    begins, ends = before[at], before[at + 1]
    share = limited((after - begins) / (ends - begins), 0, 1)
    share = ca.repmat(share.T, width, 1)
    X = (1 - share) * columns(a["X"], at) + share * columns(a["X"], at + 1)
    q = X[ATTITUDE, :]
    length = ca.sqrt(ca.sum1(q**2))
    q = q / ca.repmat(length, 4, 1)
    X = ca.vertcat(X[: ATTITUDE.start, :], q, X[ATTITUDE.stop :, :])
    U = columns(a["U"], place(after[:-1] + INSTANT))
    guess = ca.DM.zeros(inputs * (rows - 1))
    return named_function("resampled", a, {"X_new": X, "U_new": U, "guess": guess})
