"""A wind that is the same everywhere and at all times."""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.parts.settings import Triple, key, keyed
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle
from quadexp.world.effect import Clock, Effect, Moment, Sizes, Start


@keyed
class MeanWind(Effect):
    """Air that moves at one velocity, and what subclasses add to it."""

    stage = "wind"
    prefix = "wind."

    velocity: Triple = key((0.0, 0.0, 0.0), "velocity of the air, world", "[-50, 50]", "m/s")


@keyed
class ConstantWind(MeanWind):
    """The same wind everywhere and at all times. parameters: velocity (3,), world (m/s)."""

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        return Sizes(parameters=3)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        return (), self.velocity

    def wind(self, at: Moment) -> Expression:
        return at.parameters
