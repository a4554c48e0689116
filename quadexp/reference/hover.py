"""Hover at one point with one heading.  p(t) = position (world, m),  yaw(t) = yaw (rad)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.config.flight import HoverKeys
from quadexp.reference.base import N_DERIVATIVES, FlatOutput


@dataclass(frozen=True, kw_only=True)
class Hover(HoverKeys):
    """A constant position and heading; settings: see HoverKeys. Raises UsageError where one is out of range."""

    @property
    def peak_speed(self) -> float:
        return 0.0

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output."""
        k = np.size(t)
        position = np.zeros((k, N_DERIVATIVES, 3))
        position[:, 0] = self.position
        yaw = np.zeros((k, 3))
        yaw[:, 0] = self.yaw
        return FlatOutput(position, yaw)
