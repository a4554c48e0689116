"""Hover at one point with one heading.  p(t) = position (world, m),  yaw(t) = yaw (rad)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.parts.settings import Triple, key
from quadexp.reference.base import DURATION, N_DERIVATIVES, FlatOutput, TrajectoryPart


@dataclass(frozen=True, kw_only=True)
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
        k = np.size(t)
        position = np.zeros((k, N_DERIVATIVES, 3))
        position[:, 0] = self.position
        yaw = np.zeros((k, 3))
        yaw[:, 0] = self.yaw
        return FlatOutput(position, yaw)
