"""Ellipses flown at a constant angular rate, at speed from the first instant on (Sun et al. 2022, (36)-(38)).

    r = V^2 / a,   k = a / V,   b = r / n
    horizontal   p = [r sin kt, b cos kt, h],       heading towards the centre, psi = atan2(-p_y, -p_x)
    vertical     p = [r sin kt, 0, h + b cos kt],   heading constant

World ENU (m). V: speed at t = 0, the end of the minor axis; a: centripetal acceleration at the ends of the major axis.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from quadexp.errors import UsageError
from quadexp.parts.settings import key, keyed
from quadexp.reference.base import DURATION, N_DERIVATIVES, FlatOutput, TrajectoryPart, flat_output_held

LONGEST_HORIZON = 10.0  # s, for which the ellipse goes on behind the flight


@keyed
class Ellipse(TrajectoryPart):
    """An ellipse. Raises UsageError where a number is out of range.

    clipped: references stay within the vehicle's limits, where a controller only tries to follow. counts_heading: the
    heading is prescribed also where flat outputs leave it free.
    """

    former_kind = "ellipse"

    speed: float = key(10.0, "V: speed at the ends of the minor axis, where it begins", "(0, 60]", "m/s")
    acceleration: float = key(20.0, "a: centripetal acceleration at the ends of the major axis", "(0, 1000]", "m/s^2")
    ratio: float = key(1.0, "n: major axis divided by the minor one", "[1, 100]")
    plane: Literal["horizontal", "vertical"] = key("horizontal", "plane of the ellipse")
    heading: Literal["auto", "centre", "constant"] = key(
        "auto", "towards the centre, or along x; auto: constant in the vertical plane, else to the centre"
    )
    height: float = key(5.0, "height of the centre, world", "[-1000, 1000]", "m")
    duration: float = key(20.0, DURATION)

    clipped = True
    counts_heading = True

    def check_together(self) -> None:
        if self.plane == "vertical" and self.heading == "centre":
            raise UsageError("trajectory.heading=centre: a vertical ellipse has heading=constant (or auto)")

    @property
    def end(self) -> float:
        """Time (s) up to which it goes on, so that the horizon of a controller ends nowhere."""
        return self.duration + LONGEST_HORIZON

    @property
    def peak_speed(self) -> float:
        return self.speed

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output.

        The constant heading of the vertical plane is left free, which there means: y_body stays across the plane,
        upside down too.
        """
        t = np.atleast_1d(np.asarray(t, float))
        inside = (t >= 0.0) & (t <= self.end)
        t = np.clip(t, 0.0, self.end)
        rate = self.acceleration / self.speed
        major = self.speed**2 / self.acceleration
        turning = np.exp(1j * rate * t)[:, None] * (1j * rate) ** np.arange(N_DERIVATIVES)
        position = np.zeros((len(t), N_DERIVATIVES, 3))
        position[:, :, 0] = major * turning.imag
        position[:, :, 1 if self.plane == "horizontal" else 2] = major / self.ratio * turning.real
        position[:, 0, 2] += self.height
        if self.plane == "vertical":
            return flat_output_held(position, None, inside)
        if self.heading == "constant":
            return flat_output_held(position, 0.0, inside)
        return flat_output_held(position, _towards_centre(position), inside)


def _towards_centre(position: np.ndarray) -> np.ndarray:
    """Heading with its derivatives (k, 3) (rad, s) of flat outputs (k, 5, 3), continuous."""
    x, x_1, x_2 = position[:, :3, 0].T
    y, y_1, y_2 = position[:, :3, 1].T
    square = x * x + y * y
    moment = x * y_1 - y * x_1
    square_1 = 2 * (x * x_1 + y * y_1)
    moment_1 = x * y_2 - y * x_2
    yaw = np.arctan2(-y, -x)
    return np.column_stack([yaw, moment / square, (moment_1 * square - moment * square_1) / square**2])
