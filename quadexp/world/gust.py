"""A discrete gust of one-minus-cosine shape (14 CFR 25.341; as a ramp in MIL-F-8785C, 3.7.1.3), added to a mean wind.

    w(t) = w_mean + A / 2 (1 - cos(2 pi (t - t_0) / D))     for t_0 <= t <= t_0 + D, else w_mean         world, m/s

Its integral over the gust is A D / 2. A gust of length l that is met at the speed V lasts D = l / V.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.parts.settings import Triple, key, keyed
from quadexp.physics.expression import Expression, limited, split
from quadexp.physics.vehicle import Vehicle
from quadexp.world.constant_wind import MeanWind
from quadexp.world.effect import Clock, Moment, Sizes, Start


def one_minus_cosine(t: Expression, start: Expression, duration: Expression, amplitude: Expression) -> Expression:
    """Velocity (3,) (m/s) that the gust adds at the time t (s), in the axes of its amplitude A (3,) (m/s).

    start t_0 and duration D: s.
    """
    share = limited((t - start) / duration, 0, 1)  # both ends are zeros of the shape
    shape = 1 - ca.cos(2 * math.pi * share)
    return amplitude / 2 * shape


@keyed
class Gust(MeanWind):
    """A mean wind and one gust of one-minus-cosine shape.

    Parameters: mean wind (3,) and amplitude (3,), world (m/s), onset and duration (s).
    """

    amplitude: Triple = key((5.0, 0.0, 0.0), "velocity that the gust adds at its peak, world", "[-50, 50]", "m/s")
    onset: float = key(2.0, "when the gust begins", "[0, 14400]", "s")
    duration: float = key(2.0, "how long it lasts: its length over the airspeed it is met at", "[0.01, 14400]", "s")

    stage = "wind"

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        return Sizes(parameters=8)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        return (), (*self.velocity, *self.amplitude, self.onset, self.duration)

    def wind(self, at: Moment) -> Expression:
        """That of the middle of the step."""
        mean, amplitude, onset, duration = split(at.parameters, (3, 3, 1, 1))
        middle = at.t + at.step / 2
        return mean + one_minus_cosine(middle, onset, duration, amplitude)
