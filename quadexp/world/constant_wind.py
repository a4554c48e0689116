"""A wind that is the same everywhere and at all times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.config.world import ConstantWindKeys
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle
from quadexp.world.effect import Clock, Effect, Moment, Sizes, Start


@dataclass(frozen=True)
class ConstantWind(ConstantWindKeys, Effect):
    """See ConstantWindKeys. parameters: velocity (3,), world (m/s)."""

    stage = "wind"

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        """See Effect.sizes."""
        return Sizes(parameters=3)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        """See Effect.start."""
        return (), self.velocity

    def wind(self, at: Moment) -> Expression:
        """See Effect.wind."""
        return at.parameters
