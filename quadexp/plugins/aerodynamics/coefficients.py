"""Aerodynamic coefficients of rotors and airframe, which are to be identified (Lei & Li 2017, sections 2 and 3).

Equations: blade_element.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.parts.settings import REQUIRED, Settings, Triple, key

THETA = ("C_d0", "C_la", "C_Dx", "C_Dy", "C_Dz")  # order of the coefficients in a vector
C_D0, C_LA, C_DX, C_DY, C_DZ = range(5)
IDLE_SPEED = 50.0  # rad/s; the model is not defined for stopped rotors
STANDING = 1e-6  # rad/s; slower rotors count as stopped; in still air all their forces vanish


@dataclass(frozen=True)
class BladeKeys(Settings):
    """Aerodynamic coefficients of rotors and airframe; see quadexp/plugins/aerodynamics/coefficients.py."""

    lift_slope: float = key(
        REQUIRED, "lift slope C_la of the blades; in controller.rls the initial value", "(0, 20]", "1/rad"
    )
    profile_drag: float = key(
        REQUIRED, "profile drag C_d0 of the blades; in controller.rls the initial value", "(0, 10]"
    )
    body_drag: Triple = key(
        REQUIRED, "drag coefficients C_D of the airframe; in controller.rls the initial values", "[0, 10]"
    )


@dataclass(frozen=True)
class BladeCoefficients(BladeKeys):
    """Aerodynamic coefficients C_la, C_d0 and C_D (see BladeKeys). Identified ones may lie outside the ranges of the
    configuration."""

    def __post_init__(self) -> None:
        """Checks no range."""

    def parameters(self) -> np.ndarray:
        """theta = (C_d0, C_la, C_Dx, C_Dy, C_Dz), (5,)."""
        return np.array([self.profile_drag, self.lift_slope, *self.body_drag], float)

    @classmethod
    def from_parameters(cls, theta: np.ndarray) -> BladeCoefficients:
        """The inverse of `parameters`; theta (5,)."""
        c_d0, c_la, *body = (float(value) for value in theta)
        return cls(c_la, c_d0, (body[0], body[1], body[2]))
