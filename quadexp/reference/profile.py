"""Torrente's speed profile: the path angle th(t) along a closed path, accelerating from rest and back to rest.

With alpha = a / r (rad/s^2) and v the nominal speed, th'' is in successive sections

    2 s          alpha sin^2(pi tau / 4)
    v/a - 2 s    alpha
    4 s          alpha cos(pi tau / 4)          acceleration turns into deceleration; r th' peaks at v + (4/pi - 1) a
    v/a - 2 s   -alpha
    2 s          alpha (sin^2(pi tau / 4) - 1)

so th' starts and ends at exactly zero, th''' is continuous and th'''' jumps between sections.
Source: the public code of Torrente et al. 2021 (circle and lemniscate references).

Every section has the form th'' = c_0 + c_1 cos(k tau), which integrates and differentiates in closed form.
"""

from __future__ import annotations

import numpy as np

from quadexp.errors import UsageError
from quadexp.parts.settings import REQUIRED, key, keyed
from quadexp.reference.base import N_DERIVATIVES, RADIUS, SPEED, TrajectoryPart

RAMP = 2.0  # s, from rest to full acceleration
TURN = 4.0  # s, from full acceleration to full deceleration
OVERSHOOT = 4.0 / np.pi - 1.0  # s, (peak speed - nominal speed) / acceleration


@keyed
class ProfiledPath(TrajectoryPart):
    """A closed path at constant height from (radius, 0, height), with the path angle of the profile.

    yaw: heading held, rad; None: free, body yaw rate zero (Torrente et al. 2021).
    Raises UsageError where speed / acceleration is below 2 s, where the ramps alone would exceed the nominal speed.
    """

    speed: float = key(REQUIRED, SPEED)
    acceleration: float = key(
        1.0, "acceleration from rest to the nominal speed, and deceleration at the end", "(0, 50]", "m/s^2"
    )
    radius: float = key(5.0, RADIUS)
    height: float = key(1.0, "height of the path, world", "[-1000, 1000]", "m")

    yaw: float | None = None

    def check_together(self) -> None:
        if self.speed / self.acceleration < RAMP * (1 - 1e-12):
            raise UsageError(
                f"trajectory.speed: {self.speed:g} m/s at trajectory.acceleration {self.acceleration:g} m/s^2 leaves no"
                f" time for the ramps (speed / acceleration must be 2 s or more): raise speed to"
                f" {RAMP * self.acceleration:g} or lower acceleration to {self.speed / RAMP:g}"
            )

    @property
    def duration(self) -> float:
        """Length of the profile, 2 v/a + 4 (s)."""
        return 2 * self._cruise + 2 * RAMP + TURN

    @property
    def _cruise(self) -> float:
        """Length of one section of constant th'' (s)."""
        return max(self.speed / self.acceleration - RAMP, 0.0)

    def angle(self, t: np.ndarray) -> np.ndarray:
        """Path angle and its derivatives up to the fourth at 0 <= t <= duration, (k,) (s): (k, 5) (rad, s)."""
        alpha = self.acceleration / self.radius
        # columns: length (s), c_0, c_1 (rad/s^2), k (rad/s)
        length, c0, c1, k = np.transpose([
            [RAMP, alpha / 2, -alpha / 2, np.pi / 2],
            [self._cruise, alpha, 0.0, 1.0],
            [TURN, 0.0, alpha, np.pi / 4],
            [self._cruise, -alpha, 0.0, 1.0],
            [RAMP, -alpha / 2, -alpha / 2, np.pi / 2],
        ])  # fmt: skip
        rate_gain = c0 * length + c1 * np.sin(k * length) / k
        rate = np.concatenate([[0.0], np.cumsum(rate_gain)[:-1]])
        angle_gain = rate * length + c0 * length**2 / 2 + c1 * (1 - np.cos(k * length)) / k**2
        angle = np.concatenate([[0.0], np.cumsum(angle_gain)[:-1]])

        t = np.asarray(t, float)
        start = np.concatenate([[0.0], np.cumsum(length)[:-1]])
        section = np.searchsorted(start, t, side="right") - 1
        tau = t - start[section]
        c0 = c0[section]
        c1 = c1[section]
        k = k[section]
        rate = rate[section]
        angle = angle[section]
        sine = np.sin(k * tau)
        cosine = np.cos(k * tau)
        result = np.empty((len(t), N_DERIVATIVES))
        result[:, 0] = angle + rate * tau + c0 * tau**2 / 2 + c1 * (1 - cosine) / k**2
        result[:, 1] = rate + c0 * tau + c1 * sine / k
        result[:, 2] = c0 + c1 * cosine
        result[:, 3] = -c1 * k * sine
        result[:, 4] = -c1 * k**2 * cosine
        return result
