"""Horizontal circle from rest to rest (Torrente et al. 2021).

p = (r cos th, r sin th, height),  world (m),  th(t) from the speed profile,  heading free or fixed
"""

from __future__ import annotations

import numpy as np

from quadexp.parts.settings import keyed
from quadexp.reference.base import FlatOutput, flat_output_held, hold_outside, level_path
from quadexp.reference.phasor import phasor
from quadexp.reference.profile import OVERSHOOT, ProfiledPath


@keyed
class Circle(ProfiledPath):
    """Circle about the world's z axis, started at (radius, 0, height), counter-clockwise seen from above.

    The peak speed is v + 0.273 a. Arguments: see ProfiledPath.
    """

    former_kind = "circle"

    @property
    def peak_speed(self) -> float:
        """Largest speed, v + (4/pi - 1) a (m/s)."""
        return self.speed + OVERSHOOT * self.acceleration

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        t, inside = hold_outside(t, self.duration)
        point = self.radius * phasor(self.angle(t))
        return flat_output_held(level_path(point.real, point.imag, self.height), self.yaw, inside)
