"""The air's share of a reference: the residual outputs that agree with the motion they ask for.

    y = [a_air, tau_air] = r(z),    z = [v_body, w, u],    body frame

depends on the attitude, rates and rotor thrusts that follow from y itself. Unknown is y as a function of time, the
lateral part of a_air seen in the tilt frame as l. The motion under a given y (motion.py) gives z, and Newton steps at
every time by itself (air_step.py), with l', l'' from the last l by differences in time, lead to y = r(z(y)).

Where the thrusts that l'' asks for act on l again (rotors near their limits, jumps of the velocity), this does not
settle: a zigzag from node to node grows, and spreads by a node an iteration. Then l' and l'' are taken as zero in the
rates and torques that r sees, and every time is by itself. An iteration that comes no nearer for a while has stalled.

World ENU, body FLU, SI. Arrays are component first, (d, k) at k times.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import numpy as np

from quadexp.errors import UsageError
from quadexp.physics.vehicle import Vehicle
from quadexp.reference.air_model import AirModel, PartialAir
from quadexp.reference.air_step import asked_and_next, reachable
from quadexp.reference.demand import Demand
from quadexp.reference.motion import Air, Calculus, Motion, flat_motion
from quadexp.reference.traced import CompiledStep

KINK = 0.5  # m/s^2, N m: change that may be left at the instants where a rotor meets its limit, of the whole residual
SETTLED = 0.3  # m/s^2: until l changes by less in an iteration its differences in time are noise, and taken as zero
PATIENCE, PROGRESS = 12, 0.5  # iterations within which the change must fall to this share of the smallest before
FALLING, SHORTEST = 0.9, 0.1  # where the change does not fall to this share the step is halved, but no shorter than


class Outcome(Enum):
    """How an iteration ended: at the tolerance, no nearer for PATIENCE iterations, or out of iterations."""

    AGREED = "agreed"
    STALLED = "stalled"
    EXHAUSTED = "out of iterations"


@dataclass(frozen=True)
class Settings:
    """tolerance: on the last change, m/s^2 and N m. corners: whether l' = l'' = 0 may be taken, and a KINK be left."""

    tolerance: float
    max_iterations: int
    corners: bool = True


@dataclass(frozen=True)
class Iterated:
    """The last air of an iteration, the one before, and by how much it changed at every time, (k,) (m/s^2, N m)."""

    air: Air
    used: Air
    change: np.ndarray
    iterations: int
    outcome: Outcome


def agreeing_air(
    demand: Demand,
    vehicle: Vehicle,
    model: AirModel | PartialAir | None,
    calculus: Calculus,
    settings: Settings,
    start: np.ndarray | None = None,
) -> tuple[Air, Motion]:
    """The air that agrees with the motion it causes, and the motion, under a residual model or none.

    calculus: of the demand's times. start: a first guess of the air's outputs, (6, k).
    Raises UsageError where the iteration stalls or is out of iterations.
    """
    air = Air.still(len(demand.t))
    if start is not None:
        lateral = reachable(start[:2], np.linalg.norm(demand.specific_force, axis=0))
        air = Air(np.concatenate([lateral, start[2:]]), *calculus.differentiate(lateral))
    if model is None:
        return air, flat_motion(demand, vehicle, air, calculus)
    iteration = _Iteration(demand, vehicle, model, calculus, settings)
    result = iteration.run(air, held=False)
    if result.outcome is not Outcome.AGREED and settings.corners:
        result = iteration.run(air, held=True)
    if result.outcome is Outcome.AGREED or (settings.corners and result.change.max() < KINK * model.share):
        return result.air, flat_motion(demand, vehicle, result.used, calculus)
    worst = int(np.argmax(result.change))
    raise UsageError(
        f"the reference under residual {model.name!r} does not converge: {result.outcome.value} after"
        f" {result.iterations} iterations, still changing by {result.change[worst]:.2g} (m/s^2, N m), most at"
        f" t = {demand.t[worst]:.2f} s; lower trajectory.speed or check the model"
    )


class _Stall:
    """Whether the largest change has come down lately."""

    def __init__(self) -> None:
        self._smallest, self._waited = np.inf, 0

    def after(self, change: float) -> bool:
        """Whether, with this change, it has not for PATIENCE iterations."""
        if change < PROGRESS * self._smallest:
            self._smallest, self._waited = change, 0
        else:
            self._waited += 1
        return self._waited >= PATIENCE


@dataclass(frozen=True)
class _Iteration:
    """Newton steps at all times at once until nothing changes."""

    demand: Demand
    vehicle: Vehicle
    model: AirModel | PartialAir
    calculus: Calculus
    settings: Settings

    def run(self, air: Air, *, held: bool) -> Iterated:
        """From a first guess; held: with l' = l'' = 0, and shorter steps at times where the change does not fall."""
        if held:
            air = Air.of_outputs(air.outputs)
        change, share = np.full(len(self.demand.t), np.inf), np.ones(len(self.demand.t))
        settled, stall, step = held, _Stall(), self._step
        for i in range(self.settings.max_iterations):
            used, (asked, outputs) = air, step(air)
            before, change = change, np.abs(asked - air.outputs).max(axis=0)
            if held:
                longer = np.minimum(2 * share, 1) if i < PATIENCE else share  # later on: or they go round in circles
                share = np.where(change > FALLING * before, np.maximum(share / 2, SHORTEST), longer)
                outputs = air.outputs + share * (outputs - air.outputs)
            if not settled and np.abs(outputs - air.outputs)[:2].max() < SETTLED:
                settled, stall = True, _Stall()
            air = Air.of_outputs(outputs)
            if settled and not held:
                air = Air(outputs, *self.calculus.differentiate(outputs[:2]))
            result = Iterated(air, used, change, i + 1, Outcome.EXHAUSTED)
            if settled and change.max() < self.settings.tolerance:
                return replace(result, outcome=Outcome.AGREED)
            if stall.after(change.max()):
                return replace(result, outcome=Outcome.STALLED)
        return result

    @cached_property
    def _step(self) -> Callable[[Air], tuple[np.ndarray, np.ndarray]]:
        """From an air to what the model asks for there and the next outputs, (6, k) each."""
        if self.model.backend == "compiled":
            return CompiledStep(self.demand, self.vehicle, self.model, self.calculus)
        return lambda air: asked_and_next(self.demand, self.vehicle, self.model, air, self.calculus)
