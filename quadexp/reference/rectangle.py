"""The rectangle of Lei & Li 2017, Example 1: four legs at constant speed; the velocity jumps at the corners.

In the paper's NED, with the leg L = v0 T / 4:  (v0 t, 0), (L, v0 t - L), (3 L - v0 t, L), (0, 4 L - v0 t), height 5 m;
here in ENU, x east and y north. Heading north, acceleration zero everywhere, corners included, as printed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from quadexp.parts.settings import Setting, key
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION
from quadexp.reference.base import (
    DURATION,
    N_DERIVATIVES,
    SPEED,
    FlatOutput,
    TrajectoryPart,
    flat_output_held,
    hold_outside,
)

HEIGHT = Setting("height of the path, world", "(0, 1000]", "m")
Start = Annotated[
    Literal["printed", "reference"], Setting("where the flight starts: as printed in the paper, or on the reference")
]

NORTH = np.pi / 2  # yaw, rad
# xi_0 = (.2, -.2, -.1) m NED, eta_0 = (1, -1, 5) deg, at rest
START_POSITION = (-0.2, 0.2, 0.1)  # ENU, m
START_EULER = (1.0, 1.0, 85.0)  # roll, pitch, yaw of FLU in ENU, deg


@dataclass(frozen=True, kw_only=True)
class Rectangle(TrajectoryPart):
    """A square flown once, started and ended at its south-west corner, clockwise seen from above.

    start: "printed", the paper's initial state (on the ground, at rest, slightly turned),
     or "reference". Raises UsageError where a number is out of range.
    """

    former_kind = "rectangle"

    speed: float = key(5.0, SPEED)
    duration: float = key(60.0, DURATION)
    height: float = key(5.0, HEIGHT)
    start: Start = "printed"

    @property
    def peak_speed(self) -> float:
        return self.speed

    @property
    def start_state(self) -> np.ndarray | None:
        """Initial state (13,) of the flight; None: that of the reference."""
        return resting(START_POSITION, START_EULER) if self.start == "printed" else None

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output."""
        t, inside = hold_outside(t, self.duration)
        leg = self.duration / 4
        corners = self.speed * leg * np.array([[0, 0], [0, 1], [1, 1], [1, 0], [0, 0]])
        side = np.minimum(np.floor(t / leg + 1e-9).astype(int), 3)
        velocity = (corners[side + 1] - corners[side]) / leg
        position = np.zeros((len(t), N_DERIVATIVES, 3))
        position[:, 0, :2] = corners[side] + velocity * (t - side * leg)[:, None]
        position[:, 0, 2] = self.height
        position[:, 1, :2] = velocity
        return flat_output_held(position, NORTH, inside)


def resting(position: tuple[float, ...], euler: tuple[float, ...]) -> np.ndarray:
    """State (13,) at rest. position: ENU (m). euler: roll, pitch, yaw of FLU in ENU (deg)."""
    from scipy.spatial.transform import Rotation

    x = np.zeros(N_STATE)
    x[POSITION] = position
    turn = Rotation.from_euler("ZYX", euler[::-1], degrees=True)
    x[ATTITUDE] = turn.as_quat(canonical=True, scalar_first=True)
    return x
