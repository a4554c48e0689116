"""The plant seam."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from quadexp.models.build_context import BuildContext
from quadexp.models.residual import Residual
from quadexp.parts.part import Part
from quadexp.parts.settings import Backend, Setting, key, keyed
from quadexp.physics.vehicle import Vehicle

FORCE_DENSITY = Setting("spectral density of the white noise on the force, each axis", "[0, 10]", "N/sqrt(Hz)")
TORQUE_DENSITY = Setting("spectral density of the white noise on the torque, each axis", "[0, 10]", "N m/sqrt(Hz)")


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


@keyed
class PlantPart(Part):
    """What every plant has, as an option of the configuration."""

    prefix = "plant."

    step: float = key(1e-3, "largest integration step; a control period is divided evenly", "[1e-5, 0.02]", "s")
    backend: Backend = "auto"

    def build(self, context: BuildContext) -> Any:
        """The simulated truth that flies context.vehicle, a Plant. context: see BuildContext."""
        raise NotImplementedError
