"""A force and a torque from outside, constant or for a while.

    F(t) = F, tau(t) = tau     for t_0 <= t < t_0 + D, else zero                  force world (N), torque body (N m)

In a step that begins or ends the while, they act with the share of the step that lies inside, so that the impulse F D
does not depend on the step.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.parts.settings import Triple, key, keyed
from quadexp.physics.expression import Expression, split
from quadexp.physics.vehicle import Vehicle
from quadexp.world.effect import Clock, Effect, Moment, Sizes, Start

ZERO = (0.0, 0.0, 0.0)


def active_share(t: Expression, step: Expression, start: Expression, end: Expression) -> Expression:
    """Share of the step (s) from t (s) on that lies between start and end (s), 0 .. 1."""
    first = ca.fmax(t, start)
    last = ca.fmin(t + step, end)
    return ca.fmax(last - first, 0) / step


@keyed
class Disturbance(Effect):
    """A force and a torque from outside.

    Parameters: force (3,), world (N); torque (3,), body (N m); onset and end (s).
    """

    prefix = "external."

    force: Triple = key(ZERO, "force at the centre of mass, world", "[-1000, 1000]", "N")
    torque: Triple = key(ZERO, "torque, body", "[-1000, 1000]", "N m")
    onset: float = key(0.0, "when they begin to act", "[0, 14400]", "s")
    duration: float | None = key(None, "how long they act; null: to the end", "(0, 14400]", "s")

    stage = "external"

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        return Sizes(parameters=8)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        end = math.inf
        if self.duration is not None:
            end = self.onset + self.duration
        return (), (*self.force, *self.torque, self.onset, end)

    def wrench(self, at: Moment) -> tuple[Expression, Expression]:
        force, torque, onset, end = split(at.parameters, (3, 3, 1, 1))
        share = active_share(at.t, at.step, onset, end)
        return share * force, share * torque
