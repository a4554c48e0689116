"""A trajectory of your own: a circle that climbs, from rest to rest.

    p = (r cos th, r sin th, z0 + pitch th / 2 pi),    th(t) = 2 pi turns s(t / duration)

s is the polynomial of ninth order that starts and ends with four derivatives of zero, so that position, velocity,
acceleration, jerk and snap are continuous, as differential flatness needs.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial

from quadexp.parts.settings import key
from quadexp.reference.base import RADIUS, SPEED, FlatOutput, TrajectoryPart, flat_output_held, hold_outside
from quadexp.reference.phasor import phasor

SMOOTH = Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])


@dataclass(frozen=True, kw_only=True)
class HelixTrajectory(TrajectoryPart):
    """A circle that climbs, from rest to rest."""

    # The keys of trajectory=helix, each with its meaning, range and unit; swept as trajectory.radius=2,3,4.
    speed: float = key(6.0, SPEED)
    radius: float = key(3.0, RADIUS)
    pitch: float = key(1.0, "climb per turn", "[-100, 100]", "m")
    turns: float = key(3.0, "how many turns", "(0, 100]")
    height: float = key(1.0, "height of the start, world", "[-1000, 1000]", "m")

    @property
    def duration(self) -> float:
        length = 2 * np.pi * self.turns * np.hypot(self.radius, self.pitch / (2 * np.pi))
        return length * SMOOTH.deriv()(0.5) / self.speed

    @property
    def peak_speed(self) -> float:
        return self.speed

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """Position with its derivatives up to snap at the times t, (k,) s; beyond the ends the vehicle rests there."""
        t, inside = hold_outside(t, self.duration)
        share = t / self.duration
        shape = [SMOOTH(share), *(SMOOTH.deriv(n)(share) / self.duration**n for n in range(1, 5))]
        angle = 2 * np.pi * self.turns * np.stack(shape, axis=1)
        point = self.radius * phasor(angle)
        climb = self.pitch / (2 * np.pi) * angle
        climb[:, 0] += self.height
        position = np.stack([point.real, point.imag, climb], axis=2)  # (k, 5, 3): m .. m/s^4, world
        return flat_output_held(position, None, inside)  # None: the heading is free
