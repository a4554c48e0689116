"""Horizontal lemniscate (figure eight) from rest to rest (Torrente et al. 2021).

    p = (r cos th, r sin th cos th, height),  world (m),  th(t) from the speed profile,  heading free or fixed

With sin th cos th = sin(2 th) / 2 both axes are components of a phasor. |p'| = r th' sqrt(sin^2 th + cos^2 2 th), at
most sqrt(2) r th' (in the crossing).
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from quadexp.parts.settings import keyed
from quadexp.reference.base import FlatOutput, flat_output_held, hold_outside, level_path, sampled_peak_speed
from quadexp.reference.phasor import phasor
from quadexp.reference.profile import ProfiledPath


@keyed
class Lemniscate(ProfiledPath):
    """Figure eight along the world's x axis, started at (radius, 0, height).

    The peak speed is up to sqrt(2) (v + 0.273 a), see peak_speed. Arguments: see ProfiledPath.
    """

    former_kind = "lemniscate"

    @cached_property
    def peak_speed(self) -> float:
        return sampled_peak_speed(self)

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        t, inside = hold_outside(t, self.duration)
        angle = self.angle(t)
        x = self.radius * phasor(angle).real
        y = self.radius / 2 * phasor(2 * angle).imag
        return flat_output_held(level_path(x, y, self.height), self.yaw, inside)
