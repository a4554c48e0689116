"""Hover at one point with one heading.  p(t) = position (world, m),  yaw(t) = yaw (rad)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.reference.base import N_DERIVATIVES, FlatOutput, check_finite, check_point, check_positive


@dataclass(frozen=True, kw_only=True)
class Hover:
    """A constant position and heading.

    position: (3,), world, m. duration: s. yaw: rad.
    Raises UsageError where position is not a point or duration not positive.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 1.0)
    duration: float = 10.0
    yaw: float = 0.0

    def __post_init__(self) -> None:
        check_positive(duration=self.duration)
        check_finite(yaw=self.yaw)
        object.__setattr__(self, "position", check_point("position", self.position))

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
