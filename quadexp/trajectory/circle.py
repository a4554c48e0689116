"""Horizontal circle from rest to rest (Torrente et al. 2021).

p = (r cos th, r sin th, height),  world (m),  th(t) from the speed profile,  heading free or fixed
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.trajectory.base import N_DERIVATIVES, FlatOutput, check_finite, flat_output_held, hold_outside
from quadexp.trajectory.phasor import phasor
from quadexp.trajectory.profile import SpeedProfile


@dataclass(frozen=True, kw_only=True)
class Circle:
    """Circle about the world's z axis, started at (radius, 0, height), counter-clockwise seen from above.

    speed: nominal speed v, m/s; the peak is v + .273 a. acceleration: a, m/s^2. radius, height: m.
    yaw: heading held, rad; None: free, body yaw rate zero (Torrente et al. 2021).
    Raises UsageError where the numbers are out of range or speed / acceleration is below 2 s.
    """

    speed: float
    acceleration: float = 1.0
    radius: float = 5.0
    height: float = 1.0
    yaw: float | None = None

    def __post_init__(self) -> None:
        check_finite(height=self.height, yaw=self.yaw)
        _ = self.profile

    @property
    def profile(self) -> SpeedProfile:
        return SpeedProfile(self.speed, self.acceleration, self.radius)

    @property
    def duration(self) -> float:
        return self.profile.duration

    @property
    def peak_speed(self) -> float:
        return self.profile.peak_speed

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output."""
        t, inside = hold_outside(t, self.duration)
        point = self.radius * phasor(self.profile.angle(t))
        position = np.zeros((len(t), N_DERIVATIVES, 3))
        position[:, :, 0] = point.real
        position[:, :, 1] = point.imag
        position[:, 0, 2] = self.height
        return flat_output_held(position, self.yaw, inside)
