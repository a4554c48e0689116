"""Horizontal lemniscate (figure eight) from rest to rest (Torrente et al. 2021).

    p = (r cos th, r sin th cos th, height),  world (m),  th(t) from the speed profile,  heading free or fixed

With sin th cos th = sin(2 th) / 2 both axes are parts of a phasor. |p'| = r th' sqrt(sin^2 th + cos^2 2 th), at most
sqrt(2) r th' (in the crossing).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quadexp.trajectory.base import (
    N_DERIVATIVES,
    FlatOutput,
    check_finite,
    flat_output_held,
    hold_outside,
    sampled_peak_speed,
)
from quadexp.trajectory.phasor import phasor
from quadexp.trajectory.profile import SpeedProfile


@dataclass(frozen=True, kw_only=True)
class Lemniscate:
    """Figure eight along the world's x axis, started at (radius, 0, height).

    speed: nominal speed v of the profile, m/s; the vehicle's peak is up to sqrt(2) (v + .273 a), see peak_speed.
    acceleration: a, m/s^2. radius, height: m.
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

    @cached_property
    def peak_speed(self) -> float:
        return sampled_peak_speed(self)

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output."""
        t, inside = hold_outside(t, self.duration)
        angle = self.profile.angle(t)
        position = np.zeros((len(t), N_DERIVATIVES, 3))
        position[:, :, 0] = self.radius * phasor(angle).real
        position[:, :, 1] = self.radius / 2 * phasor(2 * angle).imag
        position[:, 0, 2] = self.height
        return flat_output_held(position, self.yaw, inside)
