"""A law in closed form under one setting: it is told the state and the reference of the time at which its command acts.

    late -> now -> observer of the force, told to the law -> in dead time and lag (Sooner) -> law

A law that takes no belief is told of the delays only.
"""

from __future__ import annotations

import copy as copying
import math
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.auto.ahead import LARGEST, LARGEST_LAG, Ahead, CommandedThrust
from quadexp.control.auto.auto import Auto
from quadexp.control.auto.decide import Acting
from quadexp.control.auto.following import following
from quadexp.control.base import N_BELIEF, Window
from quadexp.control.built import built
from quadexp.control.delivered import SentCommands
from quadexp.control.instant import Instant, Told, call, copy, instant_of, move
from quadexp.control.wrapped import WrappedController
from quadexp.models.residual import no_residual
from quadexp.parts.sensor_sheet import SensorSheet
from quadexp.physics.vehicle import Vehicle

SPACING = 2  # samples of the reference in a control period
DERIVATIVES = 5  # of the path: position .. snap
HELD, FREED = 0.05, 0.5  # s


class AutoLaw(Auto):
    """A law, inside its observer where it takes a belief."""

    def __init__(self, core: Any, sheet: SensorSheet, commands: SentCommands) -> None:
        world = {"push": np.zeros(6), "wind": np.zeros(3), "scale": np.ones(1)}
        sooner = Sooner(core, commands, world)
        observer = following(core, sheet) if hasattr(core, "believed_numbers") else None
        inner: Any = sooner if observer is None else observer.around(sooner)
        super().__init__(inner, core, sheet, no_residual(core.vehicle), world, observer, commands)
        self._sooner, self._thrust = sooner, CommandedThrust(commands, self.control_period, core.backend)
        if observer is not None:
            inner.delivered = self._thrust
        self._spacing = self.control_period / SPACING
        longest = LARGEST + LARGEST_LAG + core.node_times[-1]
        self.node_times = self._spacing * np.arange(math.ceil(longest / self._spacing) + 2)
        core.rows = self._rows
        self._use(Acting())

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        before, inside, now = self.before(told, state)
        inner = instant_of(self.inner, inside, now)
        operations = [*before, *inner.operations, *self.after(told, state, inner.command)]
        return inner._replace(operations=operations, logged=(*inner.logged, self._beliefs))

    def _plan(self, acting: Acting, dead_time: float, lag: float) -> None:
        """See Auto."""
        if self._observer is None:  # in the world of the model alone, predicting further would mislead it
            dead_time = lag = 0.0
        self._thrust.tune(dead_time, lag)
        self._sooner.tune(dead_time, lag)
        first = round((dead_time + lag) / self._spacing)
        self._rows[...] = first + np.round(self._core.node_times / self._spacing)


class Sooner(WrappedController):
    """A law that is told the state and the reference of the time at which its command acts.

    commands: that were sent. world: what is believed of it, for the prediction, written here.
    """

    def __init__(self, core: Any, commands: SentCommands, world: dict[str, np.ndarray]) -> None:
        super().__init__(core)
        residual = no_residual(core.vehicle)
        longest = LARGEST + LARGEST_LAG
        self._ahead = Ahead(core.vehicle, residual, core.backend, commands, world, longest)
        self._later = BufferedFunction(built(core.backend, later))
        self._world = BufferedFunction(built(core.backend, world_of, core.vehicle, core.control_period), into=world)

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset."""
        super().reset(x, window)
        self._world.arguments["share"][0] = 1.0

    @property
    def believed_numbers(self) -> np.ndarray:
        """Of the law; (11,)."""
        inner: Any = self.inner
        numbers: np.ndarray = inner.believed_numbers
        return numbers

    def believe(self, belief: Any) -> None:
        """See control.base.Belief."""
        self.believed_numbers[:] = np.hstack([*belief])

    def tune(self, dead_time: float, lag: float) -> None:
        """What commands wait and lag from now on (s)."""
        self._ahead.tune(0.0, dead_time + lag, dead_time, lag)
        self._later.arguments["ahead"][0] = dead_time + lag

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        given, left = self._later.arguments, self._later.results
        predicted, then = self._ahead.before(state)
        operations = [copy(given["path"], told.path), copy(given["yaw"], told.yaw), call(self._later)]
        inside = copying.copy(told)
        inside.path, inside.yaw = left["path_then"], left["yaw_then"]
        inner = instant_of(self.inner, inside, then)
        believing = []
        if inner.held is not None and hasattr(self.inner, "believed_numbers"):
            world, found = self._world.arguments, self._world.results
            believing = [
                copy(world["belief"], self.believed_numbers),
                copy(world["held"], inner.held),
                call(self._world),
            ]
            believing += [move(world["share"], found["share_next"]), copy(self.believed_numbers[:3], found["force"])]
        return inner._replace(operations=[*believing, *predicted, *operations, *inner.operations])


def later() -> ca.Function:
    """path (3, 5): position .. snap, yaw (4,): heading, rate, acceleration, drift; ahead (s) -> both then."""
    path, yaw, ahead = ca.SX.sym("path", 3, DERIVATIVES), ca.SX.sym("yaw", 4), ca.SX.sym("ahead")

    def then(rows: list[ca.SX]) -> list[ca.SX]:
        return [
            sum((ahead**j / math.factorial(j) * row for j, row in enumerate(rows[i:])), ca.SX(0))
            for i in range(len(rows))
        ]

    moved = ca.horzcat(*then(ca.horzsplit(path)))
    turned = ca.vertcat(*then(ca.vertsplit(yaw[:3])), yaw[3])
    return ca.Function(
        "later", [path, yaw, ahead], [moved, turned], ["path", "yaw", "ahead"], ["path_then", "yaw_then"]
    )


def world_of(vehicle: Vehicle, period: float) -> ca.Function:
    """What a law is told of a force, and the prediction of the world: push (6,), acceleration, world, and angular
    acceleration, body; wind (3,); scale of the thrust.

    belief: (11,). held: rotors at a limit in the last step. share: of the force that is told, (1,).
    Where rotors are at their limits a force cannot be answered, and a law that tries turns the vehicle away: the share
    falls in HELD, and comes back in FREED.
    """
    belief, held, share = ca.SX.sym("belief", N_BELIEF), ca.SX.sym("held"), ca.SX.sym("share")
    share_next = ca.if_else(held > 0, share * math.exp(-period / HELD), share + (1 - share) * period / FREED)
    force, spin = share_next * belief[:3], ca.mtimes(ca.inv(ca.DM(vehicle.inertia_matrix)), belief[3:6])
    push = ca.vertcat(belief[:3] / vehicle.mass, spin)
    results = {"push": push, "wind": belief[6:9], "scale": belief[9], "force": force, "share_next": share_next}
    return ca.Function(
        "believed_push", [belief, held, share], [*results.values()], ["belief", "held", "share"], [*results]
    )
