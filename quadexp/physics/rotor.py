"""Shape of a rotor, and the air around it, in blade-element theory (Lei & Li 2017, section 2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from quadexp.parts.settings import REQUIRED, Settings, key


@dataclass(frozen=True)
class RotorGeometry(Settings):
    """Shape of every rotor of a vehicle, and the density of the air."""

    prefix = "vehicle.rotor."

    radius: float = key(REQUIRED, "radius of the rotor disc", "[0.001, 10]", "m")
    chord: float = key(REQUIRED, "chord of a blade", "(0, 1]", "m")
    twist: float = key(REQUIRED, "pitch angle of a blade, constant over the radius", "(0, 1.57]", "rad")
    air_density: float = key(REQUIRED, "density of the air", "(0, 10]", "kg/m^3")
    reference_area: float = key(REQUIRED, "area that the airframe's drag coefficients refer to", "(0, 100]", "m^2")
    blades: int = key(2, "blades of a rotor", "[1, 20]")

    @property
    def blade_density(self) -> float:
        """N_b rho c / 2 (kg/m^2), the common factor of (14)-(16)."""
        return self.blades * self.air_density * self.chord / 2

    @property
    def momentum_factor(self) -> float:
        """2 rho pi r^2 (kg/m), of the momentum theory (17)."""
        return 2 * self.air_density * math.pi * self.radius**2
