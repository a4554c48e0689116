"""One setting for a vehicle that nobody measured: a controller inside a multiple-model adaptive estimator.

    told state, readings -> state of now -> disturbance filter (disturbance.py) -> belief -> MPC or law -> command
    every period of the bank (bank.py): moments;  from time to time: posterior (posterior.py) -> decision (decide.py)

It is told the vehicle, which sensors there are and their noise; nothing of delays, lags, air, load, battery or wind. A
flight begins as if nothing were known. What is remembered: the bank's memory and moments, that of the filter, the sent
commands, the last decision. Columns: COLUMNS, delays in s with their 95 % intervals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from quadexp.compile.memory import NEXT, NOW, Memory, connected, sizes_of
from quadexp.compile.symbolic import ca
from quadexp.control.base import Controller, Window
from quadexp.control.built import built
from quadexp.control.delivered import SentCommands
from quadexp.control.inputs import Circumstances
from quadexp.control.instant import Instant, Operation, Told, call, copy, instant_of, python
from quadexp.control.layer import Layer
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.wrapped import WrappedController, air_of, parameters_of, thrust_at_start
from quadexp.models.residual import Residual
from quadexp.parts.sensor_sheet import SensorSheet, Stated
from quadexp.physics.expression import dense_function, named_symbols
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.auto.ahead import Ahead
from quadexp.plugins.auto.bank import Bank
from quadexp.plugins.auto.decide import Decision, Senses, decide, known
from quadexp.plugins.auto.disturbance import DEVIATIONS, DisturbanceFilter, sources, speeds_tell
from quadexp.plugins.auto.posterior import Evidence, Posterior
from quadexp.plugins.auto.settings import BANK, DECISION, DISTURBANCE, INTERVAL
from quadexp.plugins.remedies.delay.strapdown import TunedStrapdown
from quadexp.plugins.remedies.observers.observer import COLUMNS as BELIEVED
from quadexp.plugins.remedies.observers.wind import WindObserver, wind_bandwidth

QUANTITIES = "age", "delay", "lag"
KNOWN = (
    *(f"{name}{of}" for of in ("", "_low", "_high") for name in QUANTITIES),
    "rates_newer", "acts_age", "acts_dead_time", "acts_lag", "grid",
)  # fmt: skip
ACTS = "acts_lateral", "acts_vertical", "acts_torque"
UNKNOWN = -1.0  # of what a decision has crossed: neither
COLUMNS = tuple(f"auto_{name}" for name in (*KNOWN, *ACTS, *DEVIATIONS))


class Auto(WrappedController):
    """A controller that finds out in flight what makes its model wrong.

    inner: the controller that it stands around. core: the MPC or law inside. sheet: of the sensors. residual: of the
    prediction to now. believed: arrays of the believed world, for Ahead. commands: those that were sent.
    A subclass says how it plans (`_plan`), and what delivered thrusts its filter compares (`_compared`).
    """

    delay = 0.0  # of a flight that begins

    def __init__(
        self, inner: Controller, core: Any, sheet: SensorSheet, residual: Residual, believed: dict[str, np.ndarray],
        commands: SentCommands,
    ) -> None:  # fmt: skip
        super().__init__(inner)
        self._core, self._sheet, self._commands, vehicle, period = (
            core,
            sheet,
            commands,
            inner.vehicle,
            self.control_period,
        )
        self._to_now = Ahead(vehicle, residual, inner.backend, commands, believed)
        self._late = np.zeros(1)
        part, about = TunedStrapdown(time=BANK.largest_age), Circumstances(period)
        self._strapdown = Layer(inner, part, about, places={"late": self._late})
        force, turn, attitude = (
            Stated() if one is None else one for one in (sheet.accelerometer, sheet.gyroscope, sheet.attitude)
        )
        air, theta = air_of(core), parameters_of(core)
        noise, spans = (force.noise, turn.noise, attitude.noise), (force.within(period), turn.within(period))
        self._bank = Bank(vehicle, air, theta, period, inner.backend, noise, spans)
        self._evidence = Evidence(self._bank, inner.backend)
        predictive, self.believes = isinstance(core, PredictiveController), hasattr(core, "believed_numbers")
        self._by_speeds, wind = predictive and speeds_tell(vehicle, sheet), WindObserver()
        bandwidth = wind_bandwidth(vehicle, air, theta, wind, period) if predictive else 0.0
        slope = bandwidth * wind.noise[0] * math.sqrt(period) / wind.wind_walk
        self._has_drag = bandwidth >= DISTURBANCE.least_drag_bandwidth and not self._by_speeds
        of = sources(vehicle, sheet, slope * self._has_drag, by_speeds=self._by_speeds)
        self._filter = DisturbanceFilter(vehicle, air, theta, period, inner.backend, of)
        # By which age and delays cannot be told apart: by readings that are old, or as old as nobody says, as far as a
        # data sheet may be wrong; and within a period of the bank a faster law answers to noise.
        self._apart = BANK.sheet_factor / INTERVAL.band * max(force.delay or 0.0, turn.delay or 0.0)
        self._apart += self._bank.period - period + max(period - INTERVAL.longest_period, 0.0)
        self._unsaid = turn.delay is None and bool(attitude.delay)
        lately = commands.values[-max(2, round(DECISION.saturation_memory / period)) :].reshape(-1)
        look = built(inner.backend, look_function, vehicle, self._bank.period, lately.size)
        self._memory = Memory("Auto", sizes_of([look]))
        places = {name: self._bank.part(name) for name in ("count", "weights", "noise")}
        places |= {"commands": lately, "acts": self._filter.acts}
        self._look = connected(look, places, {}, self._memory)
        self._due, self._soon, self._later = (self._look.results[name] for name in ("due", "soon", "later"))
        self._newer = np.zeros(1)
        self._beliefs, self._judged, self._begin = np.zeros(len(KNOWN)), False, Decision()
        self._decision, self._rows = Decision(), np.zeros(len(core.node_times))
        self._found: Posterior | None = None
        self._unsure = 0.0  # s, by which age and delays cannot be told apart

    def _plan(self, decision: Decision) -> None:
        """Plan with these delays, and with what else is acted on, from now on; sets `_rows`, of the reference."""
        raise NotImplementedError

    def _compared(self, told: Told, now: np.ndarray) -> tuple[list[Operation], dict[str, np.ndarray], np.ndarray]:
        """What leaves state, reading, thrust and mean of one time, see DisturbanceFilter, and whether it was read."""
        raise NotImplementedError

    def forget(self) -> None:
        """See Controller.forget: nothing is known."""
        self._use(self._begin)
        self.inner.forget()

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset: nothing is known."""
        self._use(self._begin)
        rows = self._rows.astype(int)
        inside = window._replace(state=window.state[rows], input=window.input[rows[:-1]])
        super().reset(x, inside)
        thrust = thrust_at_start(inside, self.vehicle)
        self._strapdown.reset(x, inside)
        self._commands.reset(thrust)
        self._bank.reset(x, thrust)
        self._filter.reset(x)
        self._filter.timing[0] = self._begin.timing
        self._found, self._unsure = None, 0.0
        self._memory.begin({})
        self._look.arguments["next"][0], self._look.arguments["known"][...] = DECISION.begins, UNKNOWN
        self._due[0], self._soon[0], self._later[0] = 0.0, 1.0, 0.0
        self._beliefs[...] = [*[0.0] * 3, *[np.nan] * 6, *[0.0] * 5]

    @contextmanager
    def settled(self, age: float, dead_time: float, lag: float) -> Iterator[None]:
        """Meanwhile it flies as it does once these delays (s) have been found, with the stiffest grid that it then may
        choose: what margins are taken of."""
        self._begin, self._judged = known(age, dead_time, lag), True
        try:
            yield
        finally:
            self._begin, self._judged = Decision(), False
            self.forget()

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        belief = self._filter.belief
        propagated, by_readings = self._strapdown.calls("before", told, state), self._strapdown.results["state"]
        of_rates = np.zeros(N_STATE)  # the state of the time of the rates, and from there on by the model
        propagated += [copy(of_rates, state), copy(of_rates, by_readings, self._newer)]
        predicted, now = self._to_now.before(of_rates)
        operations = [] if self._judged else self._looks()
        operations += [*propagated, *predicted]
        if self.believes and (self._by_speeds or not self._judged):  # a push alone is evidence of a push
            compared, of_one_time, read = self._compared(told, now)
            operations += [*compared, *self._filter.before(of_one_time, read)]
            operations.append(copy(self._told_belief, belief))
        inner = instant_of(self.inner, told, now)
        after = [*self._bank.after(told, state, inner.command), *self._commands.after(inner.command)]
        logged = (*inner.logged, belief, self._beliefs, self._filter.acts, self._filter.deviations)
        memory = (*inner.memory, self._strapdown.memory, self._filter.memory, self._commands.memory)
        memory = (*memory, self._bank.memory, self._bank.sums, self._memory)
        return inner._replace(operations=[*operations, *inner.operations, *after], logged=logged, memory=memory)

    @property
    def _told_belief(self) -> np.ndarray:
        """Where the inner controller is told of a belief, (11,)."""
        inner: Any = self.inner
        numbers: np.ndarray = inner.believed_numbers
        return numbers

    @property
    def lacking(self) -> list[str]:
        """What it lacks here, and what that leaves undone; a line each."""
        missing = {
            "no accelerometer: delays, wind and force are not found": not self._sheet.accelerometer,
            "no speeds of rotors that tell thrusts: these follow from the commands": not self._by_speeds,
            "a law that cannot be told a force or wind: only a late state is corrected": not self.believes,
            "no drag in the model that shows a wind: it is a force": self.believes
            and not (self._has_drag or self._by_speeds),
        }
        return [line for line, holds in missing.items() if holds]

    def log(self) -> dict[str, float]:
        """See Controller.log."""
        believed = dict(zip(BELIEVED, self._filter.belief.tolist(), strict=True))
        own = [*self._beliefs, *self._filter.acts, *self._filter.deviations]
        return {**self.inner.log(), **believed, **dict(zip(COLUMNS, map(float, own), strict=True))}

    def _looks(self) -> list[Operation]:
        """Look at the evidence so far, and decide where a decision may be another one than the last."""
        operations = []
        for each, when in ((DECISION.soonest, self._soon), (DECISION.checks, self._later)):
            every = max(2, round(each / self.control_period))
            operations += [
                copy(self._filter.lateral, self._bank.part("lateral"), when)._replace(every=every),
                copy(self._filter.noise, self._bank.part("noise"), when)._replace(every=every),
                call(self._look, when)._replace(every=every),
                python(self._decide, self._due)._replace(every=every),
            ]
        return operations

    def _decide(self) -> None:
        """Act on the evidence so far from this instant on."""
        given, seen = self._look.arguments, self._look.results
        self._due[0] = 0.0
        elapsed = self._bank.elapsed
        if elapsed >= given["next"][0] and self._bank.part("weights")[1]:
            self._found = self._evidence()
            given["next"][0] = elapsed + min(max(DECISION.pace * elapsed, DECISION.soonest), DECISION.latest)
            self._report(self._found)
        decision = decide(self._found, self._decision, Senses(*seen["senses"].tolist()))
        given["known"][...] = seen["crossed"]
        if decision != self._decision:
            given["known"][...] = UNKNOWN  # the next one goes on from this one
            self._use(decision)
        late = 0.0 if self._found is None else abs(self._found.mean[0] - decision.age)  # age that does not act
        inexact = DECISION.inexact * (decision.age + decision.total)
        self._filter.apart[0] = math.hypot(self._unsure, late, inexact)
        self._beliefs[-4:] = decision.age, decision.dead_time, decision.lag, decision.grid

    def _use(self, decision: Decision) -> None:
        """Act on this from now on."""
        self._decision, self._filter.timing[0] = decision, decision.timing
        self._late[0] = decision.newer
        self._newer[0] = decision.newer > 0
        self._to_now.tune(decision.newer - decision.age, 0.0, decision.dead_time, decision.lag)
        self._plan(decision)

    def _report(self, found: Posterior) -> None:
        """Columns: beside the posterior's quantiles, what the model of all hypotheses leaves out."""
        age, _, lag = found.mean
        apart = math.hypot(self._apart, self._unsaid * age / INTERVAL.band, INTERVAL.unlike * lag)
        self._unsure = apart
        beside = INTERVAL.band * np.hypot(INTERVAL.inexact * found.mean, apart)
        low, high = np.hypot(found.mean - found.lower, beside), np.hypot(found.upper - found.mean, beside)
        bounds = [*found.mean, *np.maximum(found.mean - low, 0.0), *(found.mean + high)]
        self._beliefs[: len(bounds) + 1] = *bounds, found.newer


def look_function(vehicle: Vehicle, period: float, commands: int) -> ca.Function:
    """Senses at a look, which limits of a decision they have crossed, and whether a decision is due: a posterior is, or
    what is crossed is not as `known`, at the last decision. count, weights, noise: of the bank, whose period is told
    (s). commands: the last ones (N). acts: of the disturbance. next: when a posterior is due (s of evidence)."""
    s, kept = DECISION, f"{NOW}saturates"
    shapes = {kept: 1, "count": 1, "weights": 3, "noise": 3, "commands": commands, "acts": 3, "next": 1, "known": 4}
    a = named_symbols(ca.SX, shapes)
    low, high = vehicle.thrust_min, vehicle.thrust_max
    elapsed = ca.fmax(a["count"] * period - BANK.settling, 0)
    soon = elapsed < s.early
    off = ca.fabs(a["commands"] - (low + high) / 2)
    saturated = ca.sum1(off > s.at_limit * (high - low) / 2) / commands
    share = ca.if_else(soon, s.soonest, s.checks) / s.corners_memory
    saturates = a[kept] + share * (saturated - a[kept])
    position = ca.sqrt(ca.fmax(a["noise"][1], 0)) * (elapsed > BANK.measured_after)
    acts = ca.mmax(a["acts"]) > 0
    crossed = ca.vertcat(position > s.large_noise, saturated > s.saturated, saturates > s.saturates, acts)
    due = ca.logic_and(elapsed >= a["next"], a["weights"][1] > 0)
    results = {
        f"{NEXT}saturates": saturates, "senses": ca.vertcat(position, saturated, saturates, acts), "crossed": crossed,
        "due": ca.logic_or(due, ca.mmax(ca.fabs(crossed - a["known"])) > 0), "soon": soon, "later": 1 - soon,
    }  # fmt: skip
    return dense_function("look", a, results)
