"""The plant seam."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from quadexp.air.base import Residual
from quadexp.physics.vehicle import Vehicle


class Plant(Protocol):
    """True dynamics of a vehicle under commanded rotor thrusts."""

    vehicle: Vehicle

    def reset(self) -> None:
        """Begin a flight: forget what an earlier one left behind."""
        ...

    def advance(
        self, x: np.ndarray, u: np.ndarray, duration: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """State (13,) after holding the command u (n,) (N) for duration (s), and what the accelerometer reads then.

        The reading is the specific force (3,), body frame (m/s^2), without sensor noise.
        """
        ...

    def residual(self) -> Residual:
        """The plant's own deterministic equations as a residual: what a perfectly informed controller would believe."""
        ...
