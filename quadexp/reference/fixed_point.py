"""The residual in a reference: residual outputs that are consistent with the motion they cause.

    y = [a_air, tau_air] = r(z),    z = [v_body, w, u],    body frame

depends on the attitude, rates and rotor thrusts that follow from y itself. The unknown is y as a function of time, with
the lateral part of a_air in the tilt frame as l. The motion for given y (motion.py) determines z. Newton steps at every
time (air_step.py), with l', l'' of the last l by finite differences in time, converge to y = r(z(y)).

Where the thrusts due to l'' act back on l (rotors near their limits, jumps of the velocity), this iteration diverges:
an oscillation between neighbouring nodes grows and spreads by a node per iteration. Then l' and l'' are set to zero in
the rates and torques that enter r, which decouples the times. An iteration without progress for a while has stalled.

World ENU, body FLU, SI. Arrays are component first, (d, k) at k times.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from quadexp.errors import UsageError
from quadexp.physics.vehicle import Vehicle
from quadexp.reference.air_step import AirModel, predicted_and_next, reachable
from quadexp.reference.motion import Air, Calculus, Demand, Motion, flat_motion
from quadexp.reference.traced import CompiledStep

KINK = 0.5  # m/s^2, N m: change accepted where a rotor reaches its limit, for the whole residual
SETTLED = 0.3  # m/s^2: until l changes by less per iteration its time derivatives are noise, and set to zero
PATIENCE = 12  # iterations within which the change must fall ..
PROGRESS = 0.5  # .. to this share of its smallest value so far
FALLING = 0.9  # where the change does not fall to this share, the step is halved ..
SHORTEST = 0.1  # .. down to this share


@dataclass(frozen=True)
class Settings:
    """tolerance: on the last change, m/s^2 and N m. corners: whether l' = l'' = 0 and a change of KINK are allowed."""

    tolerance: float
    max_iterations: int
    corners: bool = True


@dataclass(frozen=True)
class Iterated:
    """The last air of an iteration, the one before, and its last change at every time, (k,) (m/s^2, N m).

    failure: "" at the tolerance, else "stalled", without progress for PATIENCE iterations, or "out of iterations".
    """

    air: Air
    used: Air
    change: np.ndarray
    iterations: int
    failure: str


def consistent_air(
    demand: Demand, vehicle: Vehicle, model: AirModel | None, calculus: Calculus, settings: Settings,
    start: np.ndarray | None = None,
) -> tuple[Air, Motion]:  # fmt: skip
    """The residual outputs consistent with the motion they cause, and the motion; model None: no residual.

    calculus: derivatives and integrals over the demand's times. start: initial guess of the outputs, (6, k).
    Raises UsageError where the iteration stalls or runs out of iterations.
    """
    air = Air.still(len(demand.t))
    if start is not None:
        lateral = reachable(start[:2], np.linalg.norm(demand.specific_force, axis=0))
        air = Air(np.concatenate([lateral, start[2:]]), *calculus.differentiate(lateral))
    if model is None:
        return air, flat_motion(demand, vehicle, air, calculus)
    iteration = _Iteration(demand, vehicle, model, calculus, settings)
    result = iteration.run(air, decoupled=False)
    if result.failure and settings.corners:
        result = iteration.run(air, decoupled=True)
    if not result.failure or (settings.corners and result.change.max() < KINK * model.share):
        return result.air, flat_motion(demand, vehicle, result.used, calculus)
    worst = int(np.argmax(result.change))
    raise UsageError(
        f"the reference with residual {model.name!r} does not converge: {result.failure} after"
        f" {result.iterations} iterations, last change {result.change[worst]:.2g} (m/s^2, N m) at"
        f" t = {demand.t[worst]:.2f} s; lower trajectory.speed or check the model"
    )


@dataclass(frozen=True)
class _Iteration:
    """Newton steps at all times at once until convergence."""

    demand: Demand
    vehicle: Vehicle
    model: AirModel
    calculus: Calculus
    settings: Settings

    def run(self, air: Air, *, decoupled: bool) -> Iterated:
        """Iterate from a guess; decoupled: with l' = l'' = 0, and shorter steps where the change does not fall."""
        if decoupled:
            air = Air.of_outputs(air.outputs)
        change = np.full(len(self.demand.t), np.inf)
        share = np.ones(len(self.demand.t))
        settled = decoupled
        step = self._step
        smallest = np.inf  # change
        waited = 0  # iterations since it fell to PROGRESS of its smallest value
        for i in range(self.settings.max_iterations):
            used = air
            predicted, outputs = step(air)
            before = change
            change = np.abs(predicted - air.outputs).max(axis=0)
            if decoupled:
                longer = np.minimum(2 * share, 1) if i < PATIENCE else share  # later not: the iteration could cycle
                share = np.where(change > FALLING * before, np.maximum(share / 2, SHORTEST), longer)
                outputs = air.outputs + share * (outputs - air.outputs)
            if not settled and np.abs(outputs - air.outputs)[:2].max() < SETTLED:
                settled = True
                smallest = np.inf
                waited = 0
            air = Air.of_outputs(outputs)
            if settled and not decoupled:
                air = Air(outputs, *self.calculus.differentiate(outputs[:2]))
            result = Iterated(air, used, change, i + 1, "out of iterations")
            if settled and change.max() < self.settings.tolerance:
                return replace(result, failure="")
            falls = change.max() < PROGRESS * smallest
            waited += 1
            if falls:
                smallest = change.max()
                waited = 0
            if waited >= PATIENCE:
                return replace(result, failure="stalled")
        return result

    @cached_property
    def _step(self) -> Callable[[Air], tuple[np.ndarray, np.ndarray]]:
        """From an air to the model's outputs for it and the next iterate, (6, k) each."""
        if self.model.backend == "compiled":
            return CompiledStep(self.demand, self.vehicle, self.model, self.calculus)
        return lambda air: predicted_and_next(self.demand, self.vehicle, self.model, air, self.calculus)
