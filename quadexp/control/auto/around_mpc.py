"""An MPC under one setting: its observer, the dead time and lag that it plans with, and the stiffness of its grid."""

from __future__ import annotations

import copy as copying
import math

import numpy as np

from quadexp.control.auto.ahead import LARGEST, CommandsAhead, Delivered, sent_commands
from quadexp.control.auto.auto import Auto
from quadexp.control.auto.decide import LEAST_LAG, Acting, grids
from quadexp.control.auto.following import SpeedFollowing, following
from quadexp.control.base import Window
from quadexp.control.earlier import Earlier
from quadexp.control.instant import Instant, Told, copy, instant_of
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.dead_time import MotorLead
from quadexp.control.observers.observer import parameters_of
from quadexp.parts.sensor_sheet import SensorSheet, later_speeds
from quadexp.parts.settings import changed
from quadexp.physics.state import N_STATE

# Gain of an inverted lag on a change of thrust, 1 / (1 - exp(-T / lag)): more would amplify noise (15 at 500 Hz and
# 30 ms). What is not inverted counts as dead time.
LARGEST_LEAD = 2.0
SPACING = 4  # samples of the reference in a control period, so that it may be asked for later ones


class AutoMPC(Auto):
    """The MPC plans in the world that its observer believes in; its grid and weights are one of decide.GRIDS."""

    def __init__(self, core: PredictiveController, sheet: SensorSheet) -> None:
        observer = following(core, sheet)
        inner, world, mpc = observer.around(core), core.believed, core.mpc
        assert world is not None and mpc.disturbance is not None
        self._last = {"push": np.zeros(6), "wind": np.zeros(3), "scale": np.ones(1)}  # believed in the last step
        believed = {"theta": parameters_of(core), **self._last}
        commands = sent_commands(core.vehicle, core.control_period)
        super().__init__(inner, core, sheet, mpc.residual, believed, observer, commands)
        self._delivered = Delivered(commands, core.backend)
        self._world, self._grids = world, grids(core.settings)
        self._ahead, self._lead = CommandsAhead(mpc), MotorLead(mpc.limits, core.settings, core.backend)
        self._spacing = self.control_period / SPACING
        longest = LARGEST + max(settings.horizon for settings in self._grids)
        self.node_times = self._spacing * np.arange(math.ceil(longest / self._spacing) + 2)
        world.rows = self._rows
        self._by_speeds = isinstance(observer, SpeedFollowing)
        if self._by_speeds:
            whole = round(later_speeds(sheet) / self.control_period) * self.control_period  # thrusts jump in between
            self._earlier = Earlier(N_STATE + 4, whole, self.control_period)
            world.seen = self._earlier.then[:N_STATE]
        else:
            world.thrust = self._delivered.thrust
        self._use(Acting())

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        if self._by_speeds:
            self._earlier.reset(np.concatenate([x, np.zeros(4)]))
        for name, value in (("push", 0.0), ("wind", 0.0), ("scale", 1.0)):
            self._last[name][...] = value

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        before, inside, now = self.before(told, state)
        if self._by_speeds:
            seen, earlier = np.zeros(N_STATE + 4), self._earlier
            before += [copy(seen[:N_STATE], now), copy(seen[N_STATE:-1], inside.force), copy(seen[-1:], told.read)]
            before += earlier.before(seen)
            inside = copying.copy(inside)
            inside.force, inside.read, inside.turning = earlier.then[N_STATE:-1], earlier.oldest[-1:], told.turning
        inner = instant_of(self.inner, inside, now)
        numbers, push = self._world.numbers, self._core.mpc.disturbance
        beliefs = {"push": push, "wind": numbers[6:9], "scale": numbers[9:10]}
        operations = [*before, *self._delivered.before(), *inner.operations, *self.after(told, state, inner.command)]
        operations += [copy(self._last[name], value) for name, value in beliefs.items()]
        return inner._replace(operations=operations, logged=(*inner.logged, self._beliefs))

    def _plan(self, acting: Acting, dead_time: float, lag: float) -> None:
        """See Auto: the dead time in samples of the reference; what is left of it counts as lag, which is inverted."""
        self._delivered.tune(0.0, 0.0, dead_time, lag)
        invertible = -self.control_period / math.log(1 - 1 / LARGEST_LEAD)
        dead_time, lag = dead_time + max(lag - invertible, 0.0), min(lag, invertible)
        waits = round(dead_time / self._spacing) * self._spacing
        lags = lag + dead_time - waits
        lags = lags if lags > LEAST_LAG else 0.0
        settings = changed(self._grids[acting.grid], dead_time=waits, motor_lead=lags)
        self._ahead.tune(waits, lags, self._world.numbers[9] * self._commands.values)
        self._lead.tune(settings)
        self._core.use(settings, self._ahead, self._lead)
        self._rows[...] = np.round(self._core.node_times / self._spacing)
