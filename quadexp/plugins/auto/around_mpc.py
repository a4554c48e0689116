"""An MPC under one setting: the dead time and lag that it plans with, and the stiffness of its grid."""

from __future__ import annotations

import math

import numpy as np

from quadexp.compile.memory import Memory
from quadexp.control.base import Window
from quadexp.control.instant import Instant, Operation, Told, copy
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.dead_time import MotorLead
from quadexp.control.wrapped import parameters_of
from quadexp.parts.sensor_sheet import SensorSheet, later_speeds
from quadexp.parts.settings import changed
from quadexp.physics.state import N_STATE
from quadexp.plugins.auto.ahead import CommandedThrust, CommandsAhead, sent_commands
from quadexp.plugins.auto.auto import Auto
from quadexp.plugins.auto.decide import Decision, grids
from quadexp.plugins.auto.disturbance import speeds_tell
from quadexp.plugins.auto.settings import DECISION
from quadexp.plugins.remedies.earlier import Earlier


class AutoMPC(Auto):
    """The MPC plans in the world that is believed in; its grid and weights are one of DECISION.grids."""

    def __init__(self, core: PredictiveController, sheet: SensorSheet) -> None:
        core.targets = speeds_tell(core.vehicle, sheet)  # else of next to no weight beside that of the position
        numbers, mpc = core.believed_numbers, core.mpc
        assert core.believed is not None and mpc.disturbance is not None
        self._last = {"push": np.zeros(6), "wind": np.zeros(3), "scale": np.ones(1)}  # believed in the last step
        self._believed = Memory("Believed", worked=self._last)
        self._now = {"push": mpc.disturbance, "wind": numbers[6:9], "scale": numbers[9:10]}
        commands = sent_commands(core.vehicle, core.control_period)
        super().__init__(core, core, sheet, mpc.residual, {"theta": parameters_of(core), **self._last}, commands)
        self._thrust = CommandedThrust(commands, self.control_period, core.backend)
        self._world, self._grids = core.believed, grids(core.settings)
        self._ahead, self._lead = CommandsAhead(mpc), MotorLead(mpc.limits, core.settings, core.backend)
        self._spacing = self.control_period / DECISION.samples
        longest = DECISION.largest_wait + max(settings.horizon for settings in self._grids)
        self.node_times = self._spacing * np.arange(math.ceil(longest / self._spacing) + 2)
        self._world.rows = self._rows
        whole = round(later_speeds(sheet) / self.control_period) * self.control_period  # thrusts jump in between
        self._earlier = Earlier(N_STATE + 4, whole, self.control_period, core.backend)
        self._use(Decision())

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        self._earlier.reset(np.concatenate([x, np.zeros(4)]))
        for name, value in (("push", 0.0), ("wind", 0.0), ("scale", 1.0)):
            self._last[name][...] = value
        self._believed.commit()

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        made = super().instant(told, state)
        operations = [*made.operations, *(copy(self._last[k], v) for k, v in self._now.items())]
        return made._replace(operations=operations, memory=(*made.memory, self._earlier.memory, self._believed))

    def _compared(self, told: Told, now: np.ndarray) -> tuple[list[Operation], dict[str, np.ndarray], np.ndarray]:
        """See Auto. Rotor speeds are compared with the state and reading of their time."""
        if not self._by_speeds:
            known = {"x": now, "reading": told.force, "thrust": self._thrust.thrust, "mean": self._thrust.mean}
            return self._thrust.before(), known, told.read
        seen, earlier, thrust = np.zeros(N_STATE + 4), self._earlier, np.zeros(self.vehicle.n_rotors)
        operations = [copy(seen[:N_STATE], now), copy(seen[N_STATE:-1], told.force), copy(seen[-1:], told.read)]
        coefficient = self.vehicle.thrust_coefficient or 0.0
        square = Operation("square", thrust, told.speed, factor=coefficient, when=told.turning)
        operations += [*earlier.before(seen), square]
        read = np.zeros(1)
        operations += [copy(read, earlier.oldest[-1:]), copy(read, told.turning, earlier.oldest[-1:])]
        then = {"x": earlier.then[:N_STATE], "reading": earlier.then[N_STATE:-1], "thrust": thrust, "mean": thrust}
        return operations, then, read

    def _plan(self, decision: Decision) -> None:
        """See Auto: the dead time in samples of the reference; what is left of it counts as lag, which is inverted, up
        to the gain 1 / (1 - exp(-T / lag)) = largest_lead on a change of thrust. More would amplify noise."""
        self._thrust.tune(decision.dead_time, decision.lag)
        invertible = -self.control_period / math.log(1 - 1 / DECISION.largest_lead)
        waits = decision.dead_time + max(decision.lag - invertible, 0.0)
        waits = round(min(waits, DECISION.largest_wait) / self._spacing) * self._spacing
        lag = decision.total - waits
        lag = lag if lag > DECISION.least_lag else 0.0
        settings = changed(self._grids[decision.grid], dead_time=waits, motor_lead=lag)
        self._ahead.tune(waits, lag, self._world.numbers[9] * self._commands.values)
        self._lead.tune(settings)
        self._core.use(settings, self._ahead, self._lead)
        self._rows[...] = np.round(self._core.node_times / self._spacing)
