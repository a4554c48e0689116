"""The quantities of a trajectory that the flatness map uses: path, specific force a - g, and heading.

A trajectory prescribes a yaw, or leaves the heading free: the body then does not rotate about its thrust axis, w_z = 0,
from heading 0 at the start (the "yaw rate zero" of Torrente et al. 2021). A fixed yaw requires much larger body rates
and torques at high tilt: the 12 m/s circle of the paper can only be flown with a free heading.

World ENU, SI. Arrays are component first, (d, k) at k times.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quadexp.errors import UsageError
from quadexp.reference.base import Trajectory
from quadexp.reference.flat_map import Tilt, tilt

NO_ATTITUDE = 1e-3  # least share of the specific force along z_body, and least q_w of the tilt, for an attitude


@dataclass(frozen=True)
class Demand:
    """A flat output at the times t, (k,), s.

    path: position .. snap, (5, 3, k), world. specific_force: a - g, (3, k), world (m/s^2).
    yaw: yaw, yaw', yaw'', (3, k) (rad, s), or None for a free heading.
    """

    t: np.ndarray
    path: np.ndarray
    specific_force: np.ndarray
    yaw: np.ndarray | None

    @classmethod
    def of(cls, trajectory: Trajectory, t: np.ndarray, gravity: float) -> Demand:
        """The demand of a trajectory at the times t, (k,) (s); gravity in m/s^2."""
        flat = trajectory.flat_output(t)
        path = np.ascontiguousarray(flat.position.transpose(1, 2, 0))
        yaw = None if flat.yaw is None else np.ascontiguousarray(flat.yaw.T)
        return cls(t, path, path[2] + [[0.0], [0.0], [gravity]], yaw)

    @cached_property
    def size(self) -> np.ndarray:
        """Of the specific force, (k,) (m/s^2), or NO_ATTITUDE where that is more."""
        return np.maximum(np.linalg.norm(self.specific_force, axis=0), NO_ATTITUDE)

    def tilt(self, lateral: np.ndarray) -> Tilt:
        """Tilt frames for the lateral accelerations l, (2, k) (m/s^2); raises UsageError where there are none."""
        frame = tilt(self.specific_force, lateral)
        above = (frame.quaternion[0] > NO_ATTITUDE) | self._in_a_vertical_plane(lateral)
        undefined = ~((frame.force[2] > NO_ATTITUDE * self.size) & above)
        if undefined.any():
            i = int(np.argmax(undefined))
            raise UsageError(
                f"the trajectory requires free fall or inverted flight at t = {self.t[i]:.2f} s (specific force"
                f" {self.specific_force[:, i].round(2).tolist()} m/s^2), where the attitude is not determined: lower"
                " trajectory.speed"
            )
        return frame

    def _in_a_vertical_plane(self, lateral: np.ndarray) -> bool:
        """Whether all specific forces lie in the plane of x, z, with y_body across it: then the body only pitches, and
        its attitude is determined upside down too."""
        return self.yaw is None and not self.specific_force[1].any() and not lateral[1].any()
