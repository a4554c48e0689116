"""A multirotor as a rigid body with rotors: mass, inertia, rotor layout, thrust limits.

Wrench of the rotors, body frame (any layout, from positions r_i and reaction-torque signs s_i):

    T   = sum_i u_i
    tau = sum_i (r_i x u_i e_z + c_tau s_i u_i e_z)                         N m

Source: Torrente et al. 2021, section III-A (there for the x layout).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from quadexp.errors import UsageError
from quadexp.parts.part import Part
from quadexp.parts.settings import REQUIRED, Triple, key
from quadexp.physics.plausible import plausible
from quadexp.physics.rotor import RotorGeometry

GRAVITY = 9.81  # m/s^2
# The largest principal moment of a rigid body is at most the sum of the other two; measured moments may exceed that
# slightly (those of Lei & Li 2017 by 1.2 %).
INERTIA_TOLERANCE = 0.02
FORMER_NAMES = {"thrust_coefficient": "static_thrust"}  # used in hashes, so that existing files keep theirs


@dataclass(frozen=True)
class Vehicle(Part):
    """Physical parameters of a multirotor.

    Raises UsageError where the parameters are not those of a rigid body, or the vehicle cannot be controlled.
    """

    prefix: ClassVar[str] = "vehicle."

    mass: float = key(REQUIRED, "mass, without a payload", "(0, 100]", "kg")
    inertia: tuple[Triple, Triple, Triple] = key(REQUIRED, "inertia matrix, rows, kg m^2")
    rotor_position: tuple[Triple, ...] = key(
        REQUIRED, "position of every rotor in the body frame, m, in the order of the inputs u_0, u_1, ..."
    )
    rotor_spin: tuple[float, ...] = key(
        REQUIRED,
        "sign of each rotor's reaction torque about +z_body; -1: it turns counter-clockwise from above",
        "[-1, 1]",
    )
    torque_coefficient: float = key(REQUIRED, "reaction torque of a rotor divided by its thrust", "[0, 1]", "m")
    thrust_min: float = key(REQUIRED, "least thrust that can be commanded", "[0, 1000]", "N per rotor")
    thrust_max: float = key(REQUIRED, "largest thrust that can be commanded", "(0, 1000]", "N per rotor")
    rate_max: float = key(REQUIRED, "largest body rate that a reference may ask for", "(0, 100]", "rad/s")
    gravity: float = key(GRAVITY, "gravitational acceleration", "(0, 100]", "m/s^2")
    rotor: RotorGeometry | None = key(None, "shape of the rotors, for blade-element models")
    thrust_coefficient: float | None = key(
        None, "k of the static thrust curve u = k w^2 (w: rotor speed); null where no model needs it", "(0, 1]", "N s^2"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        eigenvalues = np.linalg.eigvalsh(self.inertia_matrix)
        if not np.allclose(self.inertia_matrix, self.inertia_matrix.T):
            raise UsageError("vehicle.inertia: the matrix must be symmetric")
        if eigenvalues[0] <= 0 or eigenvalues[2] > (1 + INERTIA_TOLERANCE) * (eigenvalues[0] + eigenvalues[1]):
            raise UsageError(
                f"vehicle.inertia: principal moments {eigenvalues.round(6).tolist()} kg m^2 are not those of a rigid"
                " body (all must be positive, and none larger than the sum of the other two, with a tolerance of"
                f" {INERTIA_TOLERANCE:.0%})"
            )
        if len(self.rotor_spin) != self.n_rotors:
            raise UsageError(
                f"vehicle.rotor_spin: {len(self.rotor_spin)} signs for {self.n_rotors} rotors, one each is needed"
            )
        if set(self.rotor_spin) - {1.0, -1.0}:
            raise UsageError(f"vehicle.rotor_spin={list(self.rotor_spin)}: each must be 1 or -1")
        if np.linalg.matrix_rank(self.allocation, tol=1e-9) < 4:
            raise UsageError("vehicle.rotor_position: thrust and the three torques cannot be set independently")
        if not self.thrust_min < self.hover_thrust < self.thrust_max:
            plausible(self)
            raise UsageError(
                f"vehicle.thrust_max: hovering takes {self.hover_thrust:.3g} N per rotor,"
                f" outside ({self.thrust_min:g}, {self.thrust_max:g}) N"
            )

    @property
    def n_rotors(self) -> int:
        return len(self.rotor_position)

    @property
    def size(self) -> float:
        """Largest distance between two rotors (m)."""
        position = np.array(self.rotor_position, float)
        return float(np.linalg.norm(position[:, None] - position, axis=2).max())

    @property
    def inertia_matrix(self) -> np.ndarray:
        """Inertia, (3, 3), body frame (kg m^2)."""
        return np.array(self.inertia, float)

    @cached_property
    def allocation(self) -> np.ndarray:
        """Matrix G of [T, tau_x, tau_y, tau_z] = G u, (4, n)."""
        x, y, _ = np.array(self.rotor_position, float).T
        return np.stack([np.ones(self.n_rotors), y, -x, self.torque_coefficient * np.array(self.rotor_spin, float)])

    @cached_property
    def rotor_geometry(self) -> RotorGeometry:
        """`rotor`, for a model that needs it. Raises UsageError where there is none."""
        if self.rotor is None:
            raise self._without_rotor()
        return self.rotor

    @property
    def static_thrust_coefficient(self) -> float:
        """`thrust_coefficient` (N s^2), for a model that needs it. Raises UsageError where there is none."""
        if self.thrust_coefficient is None:
            raise self._without_rotor()
        return self.thrust_coefficient

    def _without_rotor(self) -> UsageError:
        return UsageError(
            f"vehicle={self.name}: a blade-element model needs vehicle.rotor and vehicle.thrust_coefficient"
            " (vehicle=lei_li has them)"
        )

    @property
    def hover_thrust(self) -> float:
        """Thrust of one rotor in hover (N)."""
        return self.mass * self.gravity / self.n_rotors

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of all physical parameters, without the name: vehicles with equal fingerprints fly identically."""
        physics = {
            FORMER_NAMES.get(key, key): value
            for key, value in asdict(self).items()
            if key != "name" and value is not None
        }
        return hashlib.sha256(json.dumps(physics, sort_keys=True).encode()).hexdigest()[:12]
