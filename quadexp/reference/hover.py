"""Hover at one point with one heading.  p(t) = position (world, m),  yaw(t) = yaw (rad)."""

from __future__ import annotations

import numpy as np

from quadexp.parts.settings import Triple, key, keyed
from quadexp.reference.base import DURATION, FlatOutput, TrajectoryPart, standing


@keyed
class Hover(TrajectoryPart):
    """A constant position and heading. Raises UsageError where one is out of range."""

    former_kind = "hover"

    position: Triple = key((0.0, 0.0, 1.0), "position to hold, world", "[-1e6, 1e6]", "m")
    yaw: float = key(0.0, "heading", "[-7, 7]", "rad")
    duration: float = key(5.0, DURATION)

    @property
    def peak_speed(self) -> float:
        return 0.0

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        return standing(np.tile(self.position, (np.size(t), 1)), self.yaw)
