"""An accelerometer with a bias and white noise on every axis (Lei & Li 2017, equation 22).

    A = F / m + B + W,   W ~ N(0, sigma^2)                                  body frame FLU, m/s^2

F / m is the specific force, what an accelerometer at the centre of mass feels: all forces but gravity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.parts.part import Part
from quadexp.parts.settings import Triple, key


@dataclass(frozen=True, kw_only=True)
class AccelerometerPart(Part):
    """What the controller measures with: an accelerometer with bias and white noise; all else is perfect."""

    prefix = "sensor."

    accelerometer_bias: Triple = key((0.0, 0.0, 0.0), "constant error of the specific force", "[-100, 100]", "m/s^2")
    accelerometer_noise: Triple = key(
        (0.0, 0.0, 0.0), "standard deviation of the white noise on the specific force", "[0, 100]", "m/s^2"
    )

    @property
    def idle(self) -> bool:
        """See Part: it is no imperfection of the world, whose parts name a world."""
        return True

    def build(self) -> Accelerometer | None:
        """What is read with; None for a perfect accelerometer."""
        if not any(self.accelerometer_bias) and not any(self.accelerometer_noise):
            return None
        return Accelerometer(self.accelerometer_bias, self.accelerometer_noise)


@dataclass(frozen=True)
class Accelerometer:
    """bias B and noise_std sigma: (3,), body axes FLU (m/s^2); sigma is that of one reading."""

    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise_std: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def read(self, specific_force: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Readings (.., 3) (m/s^2) of specific forces (.., 3). noise: standard normal numbers, (.., 3)."""
        return specific_force + np.array(self.bias) + np.array(self.noise_std) * noise
