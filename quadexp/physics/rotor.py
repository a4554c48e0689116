"""Parameters of a rotor in blade-element theory: geometry, air, and the coefficients to be identified.

Source: Lei & Li 2017, sections 2 and 3. Equations: quadexp.physics.blade_element.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from quadexp.errors import UsageError

THETA = ("C_d0", "C_la", "C_Dx", "C_Dy", "C_Dz")  # order of the coefficients in a vector
C_D0, C_LA, C_DX, C_DY, C_DZ = range(5)
IDLE_SPEED = 50.0  # rad/s; rotors in flight do not stop, and the model is not defined for stopped rotors
STANDING = 1e-6  # rad/s; slower rotors count as stopped; in still air all their forces vanish


@dataclass(frozen=True)
class RotorGeometry:
    """Geometry of every rotor of a vehicle, and the air density.

    radius r: m. chord c: m. twist theta_tw: rad. air_density rho: kg/m^3. reference_area S: m^2, of the body drag.
    blades: N_b.
    """

    radius: float
    chord: float
    twist: float
    air_density: float
    reference_area: float
    blades: int = 2

    def __post_init__(self) -> None:
        for f in fields(self):
            if not getattr(self, f.name) > 0:
                raise UsageError(f"vehicle.rotor.{f.name}={getattr(self, f.name)}: must be positive")

    @property
    def blade_density(self) -> float:
        """N_b rho c / 2 (kg/m^2), the common factor of (14)-(16)."""
        return self.blades * self.air_density * self.chord / 2

    @property
    def momentum_factor(self) -> float:
        """2 rho pi r^2 (kg/m), of the momentum theory (17)."""
        return 2 * self.air_density * math.pi * self.radius**2


@dataclass(frozen=True)
class BladeCoefficients:
    """Aerodynamic coefficients, all dimensionless.

    lift_slope C_la: 1/rad. profile_drag C_d0. body_drag C_D: (3,), body axes.
    """

    lift_slope: float
    profile_drag: float
    body_drag: tuple[float, float, float]

    def parameters(self) -> np.ndarray:
        """theta = (C_d0, C_la, C_Dx, C_Dy, C_Dz), (5,)."""
        return np.array([self.profile_drag, self.lift_slope, *self.body_drag], float)

    @classmethod
    def from_parameters(cls, theta: np.ndarray) -> BladeCoefficients:
        """The inverse of `parameters`; theta (5,)."""
        c_d0, c_la, *body = (float(value) for value in theta)
        return cls(c_la, c_d0, (body[0], body[1], body[2]))
