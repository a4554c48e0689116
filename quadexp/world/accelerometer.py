"""An accelerometer with a bias and white noise on every axis (Lei & Li 2017, equation 22).

    A = F / m + B + W,   W ~ N(0, sigma^2)                                  body frame FLU, m/s^2

F / m is the specific force, what an accelerometer at the centre of mass feels: all forces but gravity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.errors import UsageError


@dataclass(frozen=True)
class Accelerometer:
    """bias B and noise_std sigma: (3,), body axes FLU (m/s^2); sigma is that of one reading."""

    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise_std: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not np.all(np.isfinite(self.bias)) or not min(self.noise_std) >= 0:
            raise UsageError("sensor.accelerometer: the bias must be finite and the noise not negative")

    def read(self, specific_force: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Readings (.., 3) (m/s^2) of specific forces (.., 3). noise: standard normal numbers, (.., 3)."""
        return specific_force + np.array(self.bias) + np.array(self.noise_std) * noise
