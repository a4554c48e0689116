"""The circle of Lei & Li 2017, Example 2: half of every lap at one speed, half at twice that speed.

In the paper's NED, (-r cos a, r sin a), height 5 m, r = 28 m, with a = pi t / 20 on 0 .. 20 s, then twice that rate on
20 .. 30 s, with a period of 30 s: 4.398 and 8.796 m/s; the speed jumps. Here in ENU, x east and y north. Heading north.
The acceleration is that of the path.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.parts.settings import key
from quadexp.reference.base import (
    DURATION,
    N_DERIVATIVES,
    RADIUS,
    FlatOutput,
    TrajectoryPart,
    flat_output_held,
    hold_outside,
)
from quadexp.reference.rectangle import HEIGHT, NORTH, Start, resting

START_POSITION = (0.0, 0.0, 0.0)  # ENU, m: the centre of the circle, on the ground
START_EULER = (0.0, 0.0, 90.0)  # roll, pitch, yaw of FLU in ENU, deg


@dataclass(frozen=True, kw_only=True)
class LeiLiCircle(TrajectoryPart):
    """A circle with two speeds, clockwise seen from above, started at its southernmost point.

    The fast half of a lap takes half as long as the slow one. start: "printed", the
     paper's initial state (at rest in the middle of the circle, on the ground), or "reference".
     Raises UsageError where a number is out of range.
    """

    former_kind = "lei_li_circle"

    radius: float = key(28.0, RADIUS)
    slow_half: float = key(20.0, "duration of the slow half of a lap", "(0, 3600]", "s")
    duration: float = key(60.0, DURATION)
    height: float = key(5.0, HEIGHT)
    start: Start = "printed"

    @property
    def peak_speed(self) -> float:
        return 2 * np.pi * self.radius / self.slow_half

    @property
    def start_state(self) -> np.ndarray | None:
        """Initial state (13,) of the flight; None: that of the reference."""
        return resting(START_POSITION, START_EULER) if self.start == "printed" else None

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output."""
        t, inside = hold_outside(t, self.duration)
        lap = 1.5 * self.slow_half
        into = t - lap * np.maximum(np.ceil(t / lap - 1e-9) - 1, 0)
        slow = into <= self.slow_half + 1e-9
        rate = np.where(slow, 1.0, 2.0) * np.pi / self.slow_half
        angle = np.where(slow, rate * into, np.pi + rate * (into - self.slow_half))
        # north = -r cos a, east = r sin a: east + i north = -i r exp(i a)
        powers = np.arange(N_DERIVATIVES)
        point = -1j * self.radius * np.exp(1j * angle)[:, None] * (1j * rate[:, None]) ** powers
        position = np.zeros((len(t), N_DERIVATIVES, 3))
        position[:, :, 0], position[:, :, 1] = point.real, point.imag
        position[:, 0, 2] = self.height
        return flat_output_held(position, NORTH, inside)
