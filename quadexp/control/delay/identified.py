"""Delays that nobody knows: found in the first seconds of the flight, under a soft controller, and then made good.

    at first    the published grid with soft weights (`soft`), which tolerates some 50 ms that nobody told it; dead time
                `assumed`, the middle of what it tolerates
    from        delay.after on a search in what was told and sent so far (timing.py), CANDIDATES of it in a control
                step; again until all is known, then each time that the flight is half as long again, until all is
                known to FINE_ENOUGH
    then        the state is brought to now (by gyroscope and accelerometer where the rates are fresh, by the model
                otherwise), the dead time predicted and the motors' lag inverted; and the grid and weights are those of
                the controller's own settings

What stays unknown is not made good, and the soft controller flies on: a short first node with 50 ms that nobody told
it of loses the vehicle. Columns: delay_known (0, 1), delay_time, delay_dead_time, delay_lag (s), what is made good.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadexp.control.auto.ahead import CommandsAhead
from quadexp.control.base import Controller, Measurement, Window
from quadexp.control.delay.moments import Moments
from quadexp.control.delay.prediction import Prediction
from quadexp.control.delay.strapdown import Strapdown
from quadexp.control.delay.timing import LEAST, Delays, Search
from quadexp.control.delivered import SETTLED
from quadexp.control.instant import Instant, Told, copy, instant_of, python
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.dead_time import DeadTimePredictor, MotorLead
from quadexp.control.mpc.mpc import StepRecord
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.part import Remedy
from quadexp.control.wrapped import WrappedController, innermost, layers
from quadexp.errors import UsageError
from quadexp.parts.settings import key
from quadexp.physics.state import N_STATE

LARGEST = 0.08  # s, of an age and of a dead time that are made good
LARGEST_LAG = 0.1  # s
SOFT_WEIGHT = 10.0  # of the squared position error, as published
FINE_ENOUGH = 0.001  # s, standard error of the age and of the dead time from which on nothing is looked for again
CANDIDATES = 1  # of a search, in a control step
GRID = 4  # samples of the reference in a control period, so that it may be asked for later ones
COLUMNS = ("delay_known", "delay_time", "delay_dead_time", "delay_lag")


class Identified(WrappedController):
    """A controller that finds out what makes its measurements and commands late."""

    def __init__(self, inner: Controller, config: IdentifiedPart) -> None:
        super().__init__(inner)
        self._core: Any = innermost(inner)
        self._own, self._config = self._core.settings, config
        self._soft = soft(self._own, config.assumed)
        self._core.use(self._soft, None, None)
        self._assumed = DeadTimePredictor(self._core.mpc) if config.assumed else None
        self._core.use(self._soft, self._assumed, None)
        memory = LARGEST + SETTLED * LARGEST_LAG
        self._prediction = Prediction(inner, 0.0, 0.0, 0.0, (LARGEST, memory))
        self._strapdown = Strapdown(inner, 0.0, LARGEST)
        self._ahead = CommandsAhead(self._core.mpc)
        self._thrust, self._fresh = np.zeros(inner.vehicle.n_rotors), np.zeros(1)
        if self._core.believed is not None:
            self._core.believed.thrust = self._thrust
        self._observers = [one for one in layers(inner) if hasattr(one, "be_cautious")]
        longest = LARGEST + max(self._own.horizon, self._soft.horizon)
        self._spacing = self.control_period / GRID
        self.node_times = self._spacing * np.arange(math.ceil(longest / self._spacing) + 2)
        self._aim()

    def forget(self) -> None:
        """See Controller.forget: nothing is known of the delays."""
        self._core.use(self._soft, self._assumed, None)
        self.inner.forget()

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset: nothing is known."""
        self._core.use(self._soft, self._assumed, None)
        self.found: Delays | None = None
        self._moments = Moments(self.vehicle, self.control_period)
        self._search: Search | None = None
        self._next: float = round(self._config.after / self.control_period)
        self._strapdown.delay, self._fresh[0], self._made_good = 0.0, 0.0, (0.0, 0.0, 0.0, 0.0)
        self._running = None
        self._aim()
        inside = self._inside(window)
        for one in (self._prediction, self._strapdown):
            one.reset(x, inside)
        self._prediction.tune(0.0, 0.0, 0.0)
        self._be_cautious(True, None)

    def step(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, StepRecord]:
        """See Controller.step."""
        self._look(measurement.state)
        return super().step(measurement, self._inside(window))

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        prediction, strapdown, commands = self._prediction, self._strapdown, self._prediction.commands
        predicted, by_model = prediction.before(told, state)
        propagated, by_readings = strapdown.before(told, state)
        now = np.zeros(N_STATE)
        inner = instant_of(self.inner, told, now)

        def add() -> None:
            if self._next < math.inf:
                self._moments.add(told.t, state, told.force, inner.command)

        operations = [python(self._tell_thrusts), *predicted, *propagated, copy(now, by_model)]
        operations += [copy(now, by_readings, self._fresh), *inner.operations, *commands.after(inner.command)]
        return inner._replace(operations=[*operations, python(add, told.read)])

    def log(self) -> dict[str, float]:
        """See Controller.log."""
        return {**self.inner.log(), **dict(zip(COLUMNS, self._made_good, strict=True))}

    def _inside(self, window: Window) -> Window:
        """The reference at the times that the inner controller asks for now."""
        return window._replace(state=window.state[self._rows], input=window.input[self._rows[:-1]])

    def _aim(self) -> None:
        self._rows = np.round(self._core.node_times / self._spacing).astype(int)

    def _tell_thrusts(self) -> None:
        """What the rotors deliver now, for an observer in the MPC's step."""
        self._thrust[...] = self._delivered @ self._prediction.commands.values

    def _be_cautious(self, cautious: bool, x: np.ndarray | None) -> None:
        """Observers inside: whether they rely on the time of the thrusts."""
        for one in self._observers:
            one.be_cautious(cautious, x)
        dead_time, lag = (self._config.assumed, 0.0) if cautious else (self._prediction.dead_time, self._prediction.lag)
        self._delivered = self._prediction.commands.weights(np.zeros((1, 2)), dead_time, lag)[0]

    def _look(self, x: np.ndarray) -> None:
        """Go on with a search, or begin one where it is time; make good what it has found."""
        search, samples = self._search, self._moments.samples
        if search is None:
            if samples >= max(self._next, LEAST):
                self._search = Search(self._moments)
            return
        for _ in range(CANDIDATES):
            if search.go_on() and search.found is not None:
                self._search, self._next = None, samples + 1
                self._take(search.found, x)
                return

    def _take(self, found: Delays, x: np.ndarray) -> None:
        """Make good what is known."""
        self.found = found
        if found.age_known:
            self._make_young(found)
        if found.commands_known:
            self._make_early(found)
            self._be_cautious(False, x)
        known = found.age_known and found.commands_known
        if known:
            fine = max(found.age_error, found.dead_time_error) < FINE_ENOUGH
            self._next = math.inf if fine else 1.5 * self._moments.samples
        self._made_good = (float(known), self._prediction.delay or self._strapdown.delay, *self._made_good[2:])

    def _make_young(self, found: Delays) -> None:
        age = min(found.age, LARGEST)
        self._strapdown.delay = age if found.gyro_fresh else 0.0
        self._fresh[0] = self._strapdown.delay > 0
        self._prediction.tune(0.0 if found.gyro_fresh else age, self._prediction.dead_time, self._prediction.lag)

    def _make_early(self, found: Delays) -> None:
        dead_time = min(round(found.dead_time / self._spacing) * self._spacing, LARGEST)
        lag = min(found.lag, LARGEST_LAG)
        settings = replace(self._own if found.age_known else self._soft, dead_time=dead_time, motor_lead=lag)
        self._prediction.tune(self._prediction.delay, found.dead_time, lag)
        scale = 1.0 if self._core.believed is None else self._core.believed.numbers[9]
        self._ahead.tune(dead_time, lag, scale * self._prediction.commands.values)
        self._core.use(settings, self._ahead, MotorLead(self.vehicle, settings) if lag else None)
        self._made_good = (self._made_good[0], self._made_good[1], dead_time, lag)
        self.recompose()
        self._aim()


def soft(settings: MPCSettings, dead_time: float) -> MPCSettings:
    """The published grid and weights, for a controller that does not know its delays; nodes remain as many."""
    x, y, z = (min(weight, SOFT_WEIGHT) for weight in settings.position_weight)
    horizon = settings.nodes * max(0.1, settings.control_period)
    return replace(settings, first_node=0.0, horizon=horizon, position_weight=(x, y, z), dead_time=dead_time)


@dataclass(frozen=True, kw_only=True)
class IdentifiedPart(Remedy):
    """Delays that are found in flight."""

    prefix = "delay."
    finds_delays = True

    after: float = key(
        3.0, "time after which delays are looked for, and again as the flight gets longer", "[2, 60]", "s"
    )
    assumed: float = key(0.03, "dead time that is predicted until they are known", "[0, 0.1]", "s")

    def around(self, controller: Any) -> Identified:
        """See Remedy. Raises UsageError where the controller is no MPC of this program, or is told of delays itself."""
        core = innermost(controller)
        if type(core) is not PredictiveController:
            raise UsageError(
                f"delay={self.name}: this controller is no MPC whose grid can follow what is found; find the delays"
                " with `quadexp identify --method delays FLIGHT` and give them: delay=prediction or delay=strapdown"
            )
        if controller.control_period != core.control_period:
            raise UsageError(f"delay={self.name}: not around an inner loop with a rate of its own; give delay.time")
        if core.settings.dead_time or core.settings.known_lag:
            raise UsageError(
                f"delay={self.name}: finds dead time and lag itself; controller.dead_time, controller.motor_lag and"
                " controller.motor_lead must be 0"
            )
        return Identified(controller, self)
