"""The paths of Lei & Li 2017: the rectangle of Example 1 and the circle of Example 2, on which the velocity jumps.

Rectangle, in the paper's NED, with the leg L = v0 T / 4:  (v0 t, 0), (L, v0 t - L), (3 L - v0 t, L), (0, 4 L - v0 t);
acceleration zero everywhere, corners included, as printed.

Circle, half of every lap at one speed, half at twice that speed: (-r cos a, r sin a), r = 28 m, with a = pi t / 20 on
0 .. 20 s, then twice that rate on 20 .. 30 s, with a period of 30 s: 4.398 and 8.796 m/s. The acceleration is that of
the path.

Both at a height of 5 m, heading north. Here in ENU, x east and y north.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np

from quadexp.parts.settings import Setting, key, keyed
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION
from quadexp.reference.base import (
    DURATION,
    N_DERIVATIVES,
    RADIUS,
    SPEED,
    FlatOutput,
    TrajectoryPart,
    flat_output_held,
    hold_outside,
    level_path,
)

HEIGHT = Setting("height of the path, world", "(0, 1000]", "m")
Start = Annotated[
    Literal["printed", "reference"], Setting("where the flight starts: as printed in the paper, or on the reference")
]

NORTH = np.pi / 2  # yaw, rad


@keyed
class LeiLiPath(TrajectoryPart):
    """What both have in common. start: "printed", the paper's initial state, or "reference"."""

    printed_start: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]]

    duration: float = key(60.0, DURATION)
    height: float = key(5.0, HEIGHT)
    start: Start = "printed"

    @property
    def start_state(self) -> np.ndarray | None:
        """Initial state (13,) of the flight; None: that of the reference."""
        if self.start == "reference":
            return None
        from scipy.spatial.transform import Rotation

        position, euler = self.printed_start  # ENU (m); roll, pitch, yaw of FLU in ENU (deg)
        x = np.zeros(N_STATE)
        x[POSITION] = position
        turn = Rotation.from_euler("ZYX", euler[::-1], degrees=True)
        x[ATTITUDE] = turn.as_quat(canonical=True, scalar_first=True)
        return x


@keyed
class Rectangle(LeiLiPath):
    """A square flown once, started and ended at its south-west corner, clockwise seen from above.

    Printed start: on the ground, at rest, slightly turned; in NED xi_0 = (0.2, -.2, -.1) m, eta_0 = (1, -1, 5) deg.
    """

    former_kind = "rectangle"
    printed_start = (-0.2, 0.2, 0.1), (1.0, 1.0, 85.0)

    speed: float = key(5.0, SPEED)

    @property
    def peak_speed(self) -> float:
        return self.speed

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        t, inside = hold_outside(t, self.duration)
        leg = self.duration / 4
        corners = self.speed * leg * np.array([[0, 0], [0, 1], [1, 1], [1, 0], [0, 0]])
        side = np.minimum(np.floor(t / leg + 1e-9).astype(int), 3)
        velocity = (corners[side + 1] - corners[side]) / leg
        plane = np.zeros((2, len(t), N_DERIVATIVES))
        plane[:, :, 0] = (corners[side] + velocity * (t - side * leg)[:, None]).T
        plane[:, :, 1] = velocity.T
        return flat_output_held(level_path(plane[0], plane[1], self.height), NORTH, inside)


@keyed
class LeiLiCircle(LeiLiPath):
    """A circle with two speeds, clockwise seen from above, started at its southernmost point.

    The fast half of a lap takes half as long as the slow one. Printed start: at rest in the middle, on the ground.
    """

    former_kind = "lei_li_circle"
    printed_start = (0.0, 0.0, 0.0), (0.0, 0.0, 90.0)

    radius: float = key(28.0, RADIUS)
    slow_half: float = key(20.0, "duration of the slow half of a lap", "(0, 3600]", "s")

    @property
    def peak_speed(self) -> float:
        return 2 * np.pi * self.radius / self.slow_half

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        t, inside = hold_outside(t, self.duration)
        lap = 1.5 * self.slow_half
        into = t - lap * np.maximum(np.ceil(t / lap - 1e-9) - 1, 0)
        slow = into <= self.slow_half + 1e-9
        rate = np.where(slow, 1.0, 2.0) * np.pi / self.slow_half
        angle = np.where(slow, rate * into, np.pi + rate * (into - self.slow_half))
        # north = -r cos a, east = r sin a: east + i north = -i r exp(i a)
        powers = np.arange(N_DERIVATIVES)
        point = -1j * self.radius * np.exp(1j * angle)[:, None] * (1j * rate[:, None]) ** powers
        return flat_output_held(level_path(point.real, point.imag, self.height), NORTH, inside)
