"""One setting for a vehicle that nobody measured: a controller inside a multiple-model adaptive estimator.

    given state, readings -> state of now -> disturbance filter (disturbance.py) -> belief -> MPC or law -> command
    every period of the bank (bank.py): moments;  from time to time: posterior (posterior.py) -> decision (decide.py)

It is given the vehicle, which sensors there are and their noise; nothing of delays, lags, air, load, battery or wind. A
flight begins as if nothing were known. What is remembered: the bank's memory and moments, that of the filter, the sent
commands, the last decision. Columns: COLUMNS, delays in s with their 95 % intervals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.memory import Memory, connected
from quadexp.compile.symbolic import ca
from quadexp.control.base import Window
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, ControlStep, InputArrays, call, control_step_of, copy, run
from quadexp.control.inputs import Circumstances, Inputs
from quadexp.control.layer import Layer
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.wrapped import WrappedController, air_of, parameters_of, thrust_at_start
from quadexp.models.residual import Residual
from quadexp.names import named
from quadexp.parts.sensor_spec import SensorSpec, Stated
from quadexp.physics.expression import named_function
from quadexp.physics.state import N_STATE
from quadexp.plugins.auto.ahead import Ahead, delivered_thrusts, prediction_numbers, sent_commands, span_weights
from quadexp.plugins.auto.bank import Bank
from quadexp.plugins.auto.decide import KEPT, NOTHING, Decision, decision_function, known, start_of
from quadexp.plugins.auto.disturbance import DEVIATIONS, DisturbanceFilter
from quadexp.plugins.auto.posterior import Search
from quadexp.plugins.auto.settings import BANK, DECISION, DISTURBANCE, INTERVAL
from quadexp.plugins.auto.sources import sources, speeds_tell
from quadexp.plugins.remedies.delay.strapdown import TunedStrapdown
from quadexp.plugins.remedies.observers.observer import COLUMNS as BELIEVED
from quadexp.plugins.remedies.observers.wind import WindObserver, wind_bandwidth

QUANTITIES = "age", "delay", "lag"
KNOWN = (
    *(f"{name}{of}" for of in ("", "_low", "_high") for name in QUANTITIES),
    "rates_newer",
    "acts_age",
    "acts_dead_time",
    "acts_lag",
    "grid",
)
ACTS = "acts_lateral", "acts_vertical", "acts_torque"
COLUMNS = tuple(f"auto_{name}" for name in (*KNOWN, *ACTS, *DEVIATIONS))


class Auto(WrappedController):
    """A controller that finds out in flight what makes its model wrong.

    core: the MPC or law that it stands around. residual, theta: of the prediction to now, and its parameters. A
    subclass says how it plans (`_plans`), and may compare other thrusts than those that the commands give
    (`_compared`).
    """

    wrapped: Any
    delay = 0.0  # of a flight that begins
    settles = ""  # what its margins are of, where the delays are among those that it looks for

    def __init__(self, core: Any, sensor_spec: SensorSpec, residual: Residual, theta: np.ndarray) -> None:
        super().__init__(core)
        vehicle, backend, period = core.vehicle, core.backend, self.control_period
        self._sensor_spec = sensor_spec
        self._commands = sent_commands(vehicle, period)
        self._world = {"push": np.zeros(6), "wind": np.zeros(3), "scale": np.ones(1)}  # assumed in the last step
        self._believed = Memory("Believed", worked=self._world)
        self._to_now = Ahead(vehicle, residual, backend, self._commands, self._world | {"theta": theta})
        self._delivered = delivered_thrusts(self._commands, backend, 2)  # now, and over the last period
        self._late, self._newer = np.zeros((2, 1))
        strapdown = TunedStrapdown(time=BANK.largest_age)
        self._strapdown = Layer(core, strapdown, Circumstances(period), places={"late": self._late})
        self._rows = np.zeros(len(core.node_times))
        self._judged, self._begin = False, NOTHING
        self.judged: dict[str, Any] = {}  # what its margins are of, and the grid
        self._tune: BufferedFunction
        self._plan: Memory

        air, air_theta = air_of(core), parameters_of(core)
        accelerometer = sensor_spec.accelerometer or Stated()
        gyroscope = sensor_spec.gyroscope or Stated()
        attitude = sensor_spec.attitude or Stated()
        noise = accelerometer.noise, gyroscope.noise, attitude.noise
        spans = accelerometer.within(period), gyroscope.within(period)
        self._bank = Bank(vehicle, air, air_theta, period, backend, noise, spans)

        self.believes = hasattr(core, "believed_numbers")
        self._by_speeds, self._has_drag, slope = False, False, 0.0
        if isinstance(core, PredictiveController):
            self._by_speeds = speeds_tell(vehicle, sensor_spec)
            wind = WindObserver()
            bandwidth = wind_bandwidth(vehicle, air, air_theta, wind, period)
            self._has_drag = bandwidth >= DISTURBANCE.least_drag_bandwidth and not self._by_speeds
            slope = bandwidth * wind.noise[0] * math.sqrt(period) / wind.wind_walk
        self._memory = Memory("Auto", KEPT)
        now, measured = self._memory.of_now, self._bank.memory.of_now
        told = {"lateral": measured["lateral"], "noise": measured["noise"]}
        told |= {"timing": now["decision"][-1:], "delays": now["decision"][:3]}
        told |= {"apart": now["apart"], "late": now["late"]}
        known = sources(vehicle, sensor_spec, slope * self._has_drag, by_speeds=self._by_speeds)
        self._filter = DisturbanceFilter(vehicle, air, air_theta, period, backend, known, told)

        self._search = Search(self._bank, backend, {name: now[name] for name in ("searches", "rounds")})
        # By which age and delays cannot be distinguished: by readings that are old, or as old as nobody says, as far as
        # a data sheet may be wrong; and within a period of the bank a faster law answers to noise.
        oldest = max(accelerometer.delay or 0.0, gyroscope.delay or 0.0)
        apart = BANK.sheet_factor / INTERVAL.band * oldest
        apart += self._bank.period - period + max(period - INTERVAL.longest_period, 0.0)
        unsaid = gyroscope.delay is None and bool(attitude.delay)
        count = max(2, round(DECISION.saturation_memory / period))
        lately = self._commands.values[-count:].reshape(-1)
        form = vehicle, period, self._bank.period, lately.size, apart
        function = cached_function(backend, decision_function, *form, unsaid=unsaid)
        places = {name: self._bank.memory.of_next[name] for name in ("count", "weights", "noise", "x")}
        self._path = np.zeros(N_STATE)  # of the reference, later
        places |= {"commands": lately, "acts": self._filter.acts, "path": self._path}
        places |= self._search.left | self._search.found
        self._decide = connected(function, places, {}, self._memory)

    def _plans(self, places: dict[str, np.ndarray], tuned: dict[str, np.ndarray], form: Any, *about: Any) -> None:
        """How it plans with a decision, see plan_function: what that reads beside the decision, and the arrays that it
        writes."""
        common = self._to_now.tuned("late") | {"late": self._late, "newer": self._newer}
        common |= {"delivered": self._delivered.arguments["weights"], "rows": self._rows}
        count, parts = len(self._commands.values), self._to_now.parts
        function = cached_function(self.backend, plan_function, form, self.control_period, count, parts, *about)
        decision = self._memory.of_next["decision"]
        self._tune = BufferedFunction(function, places | {"decision": decision}, common | tuned)
        self._plan = Memory("Plan", worked=self._tune.results, when=self._decide.results["retunes"])

    def _retuned(self, when: np.ndarray | None = None) -> list[Call]:
        """Plan with the last decision from now on."""
        return [call(self._tune, when)]

    def _compared(self, inputs: InputArrays, now: np.ndarray) -> tuple[list[Call], dict[str, np.ndarray], np.ndarray]:
        """What leaves state, reading, thrust and mean of one time, see DisturbanceFilter, and whether it was read."""
        thrust, mean = self._delivered.results["thrust"]
        known = {"x": now, "reading": inputs.specific_force, "thrust": thrust, "mean": mean}
        return [call(self._delivered)], known, inputs.accelerometer_valid

    def _planned(self, inputs: InputArrays, now: np.ndarray) -> ControlStep:
        """What the controller inside does in the state of now, which is found there, (13,)."""
        return control_step_of(self.wrapped, inputs, now)

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset: nothing is known."""
        self._anew()
        rows = self._rows.astype(int)
        states, thrusts = window.state[rows], window.input[rows[:-1]]
        inside = window._replace(state=states, input=thrusts)
        super().reset(x, inside)
        for memory, values in self.starts(x, thrust_at_start(inside, self.vehicle)):
            memory.begin(values)
        self._bank.sums.begin({})
        self._filter.assume_nothing()

    def looks_for(self, age: float, dead_time: float, lag: float) -> bool:
        """Whether these delays (s) are among those that it can find."""
        return age <= BANK.largest_age and dead_time <= BANK.largest_dead_time and lag <= BANK.largest_lag

    @contextmanager
    def settled(self, age: float, dead_time: float, lag: float) -> Iterator[None]:
        """Meanwhile it flies as it does once these delays (s) have been found, with the stiffest grid that it then may
        choose: what margins are taken of."""
        self._begin, self._judged = known(age, dead_time, lag, self.control_period), True
        found = self.settles if self.looks_for(age, dead_time, lag) else "with the largest delays that are looked for"
        self.judged = {"judged": found, "grid": self._begin.grid}
        try:
            yield
        finally:
            self._begin, self._judged = NOTHING, False

    def _anew(self) -> None:
        """Nothing has been seen, and it plans accordingly."""
        self._memory.begin(start_of(self._begin))
        self._search.memory.begin({})
        run(self._retuned())
        self._plan.commit()

    def starts(self, x: np.ndarray, thrust: np.ndarray) -> list[tuple[Memory, dict[str, Any]]]:
        """What is remembered as a flight begins, see `reset`, of its own memories and that of its strapdown; x, (13,),
        and thrust, (n,), may be symbols."""
        inputs = Inputs(self.vehicle, self._strapdown.about, ca.SX)
        strapdown = self._strapdown.part.start(inputs, x, thrust)
        sent = np.tile(thrust, len(self._commands.values))
        self._anew()
        plan = {name: values.copy() for name, values in self._plan.of_now.items()}
        return [
            (self._strapdown.memory, strapdown),
            (self._filter.memory, self._filter.start(x)),
            (self._commands.memory, {"commands": sent}),
            (self._bank.memory, self._bank.start(x, thrust)),
            (self._memory, start_of(self._begin)),
            (self._plan, plan),
            (self._believed, {"scale": np.ones(1)}),
        ]

    def control_step(self, inputs: InputArrays, state: np.ndarray) -> ControlStep:
        """See control.control_step."""
        belief = self._filter.belief
        calls = self._strapdown.calls("before", inputs, state)
        of_rates = np.zeros(N_STATE)  # the state of the time of the rates, and from there on by the model
        calls.append(copy(of_rates, state))
        calls.append(copy(of_rates, self._strapdown.results["state"], self._newer))
        predicted, now = self._to_now.before(of_rates)
        calls += predicted
        if self.believes and (self._by_speeds or not self._judged):  # a push alone is evidence of a push
            compared, of_one_time, read = self._compared(inputs, now)
            calls += [*compared, *self._filter.before(of_one_time, read)]
            calls.append(copy(self.wrapped.believed_numbers, belief))
        step = self._planned(inputs, now)
        calls += step.calls
        calls += self._bank.after(inputs, state, step.command)
        calls += self._commands.after(step.command)
        beliefs = self._memory.of_now["beliefs"]
        logged = (*step.logged, belief, beliefs, self._filter.acts, self._filter.deviations)
        memory = (*step.memory, self._strapdown.memory, self._filter.memory, self._commands.memory)
        memory = (*memory, self._bank.memory, self._bank.sums, self._believed)
        if not self._judged:
            decided = self._search.calls()
            decided += [call(self._decide), self._search.moved()]
            decided += self._retuned(self._decide.results["retunes"])
            calls += [operation._replace(decides=True) for operation in decided]
            memory = (*memory, self._search.memory, self._memory, self._plan)
        return step._replace(calls=calls, logged=logged, memory=memory)

    def remarks(self, columns: Mapping[str, np.ndarray], margins: Mapping[str, Any]) -> list[str]:
        """On a flight: what it lacked, and what that left undone; how it flew otherwise than its margins say."""
        missing = []
        if not self._sensor_spec.accelerometer:
            missing.append("no accelerometer: delays, wind and force are not found")
        if not self._by_speeds:
            unused = speeds_tell(self.vehicle, self._sensor_spec)
            speeds = "speeds of rotors tell a law nothing" if unused else "no speeds of rotors that tell thrusts"
            missing.append(f"{speeds}: thrusts follow from the commands")
        if not self.believes:
            missing.append("a law that cannot be given a force or wind: only a late state is corrected")
        elif not (self._has_drag or self._by_speeds):
            missing.append("no drag in the model that shows a wind: it is a force")
        stiffer = np.sum(columns["auto_grid"] > margins.get("grid", math.inf))
        if stiffer:
            share = 100 * stiffer / len(columns["auto_grid"])
            missing.append(f"a stiffer horizon than that of the margins in {share:.2g} % of the time")
        return missing

    def log(self) -> dict[str, float]:
        """See Controller.log."""
        believed = named(BELIEVED, self._filter.belief.tolist())
        own = np.hstack([self._memory.of_now["beliefs"], self._filter.acts, self._filter.deviations])
        return {**self.wrapped.log(), **believed, **named(COLUMNS, own.tolist())}


def plan_function(form: Any, period: float, count: int, parts: int, *about: Any) -> ca.Function:
    """What is tuned by a decision, (6,), see Auto._plans, and what `form` makes of it and of `about`: further symbols,
    dead time and lag of the thrusts (s), rows of the reference, and the rest by name."""
    decision = ca.MX.sym("decision", 6)
    acts = Decision(*ca.vertsplit(decision))
    weights = span_weights(count, period)
    symbols, (dead_time, lag), rows, rest = form(acts, period, *about)
    to_now = acts.newer - acts.age, 0
    results = prediction_numbers("late", weights, parts, to_now, acts.dead_time, acts.lag)
    now = weights(ca.vertcat(0, 0, dead_time, lag))
    mean = weights(ca.vertcat(-period, 0, dead_time, lag))
    results |= {"late": acts.newer, "newer": acts.newer > 0}
    results |= {"delivered": ca.horzcat(now, mean), "rows": rows, **rest}
    dense = {name: ca.densify(value) for name, value in results.items()}
    return named_function("plan", {"decision": decision} | symbols, dense)
