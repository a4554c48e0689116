"""A multirotor as a rigid body with rotors: mass, inertia, rotor layout, thrust limits.

Wrench of the rotors, body frame (any layout, from positions r_i and reaction-torque signs s_i):

    T   = sum_i u_i
    tau = sum_i (r_i x u_i e_z + c_tau s_i u_i e_z)                         N m

Source: Torrente et al. 2021, section III-A (there for the x layout).

A number in another unit is off by 10 to 10^9 and stands out in a ratio of the vehicle's own numbers. With m the mass, r
the longest arm, J a principal moment, W the weight, T and k the largest thrust and the thrust coefficient of one of n
rotors, c its torque coefficient, R its radius, A the reference area of the body's drag:

    ratio          allowed       shipped vehicles, 27 g to 1 kg
    m / r^3        5 .. 5000     77 .. 632 kg/m^3
    J / (m r^2)    0.015 .. 3    0.14 .. 1.1; all mass at the rotors: 0.5, 0.5, 1
    n T / W        .. 30         1.5 .. 10; racing quadrotors reach 15
    c / r          .. 3          0.06 .. 1.2
    sqrt(T / k) r  20 .. 800     103 .. 342 m/s; the tips of the blades are slower than sound
    R / r          0.05 .. 1.5   0.53 .. 0.59
    A / r^2        0.01 .. 30    3.1

The bounds are the range of the shipped vehicles (conf/vehicle names their sources), about ten times wider where physics
sets no end: vehicles of 20 g and of 40 kg are inside.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import UsageError
from quadexp.names import sha256_of
from quadexp.parts.part import Part
from quadexp.parts.settings import REQUIRED, Triple, key
from quadexp.physics.rotor import RotorGeometry

GRAVITY = 9.81  # m/s^2
# The largest principal moment of a rigid body is at most the sum of the other two; measured moments may exceed that
# slightly (those of Lei & Li 2017 by 1.2 %).
INERTIA_TOLERANCE = 0.02
LENGTHS = {"mm": 1e-3, "cm": 1e-2, "in": 0.0254}  # m
MOMENTS = {"g m^2": 1e-3, "kg cm^2": 1e-4, "kg mm^2": 1e-6, "g cm^2": 1e-7, "g mm^2": 1e-9}  # kg m^2
FORMER_NAMES = {"thrust_coefficient": "static_thrust"}  # used in hashes, so that existing files keep theirs


@dataclass(frozen=True)
class Vehicle(Part):
    """Physical parameters of a multirotor.

    Raises UsageError where the parameters are not those of a rigid body, or the vehicle cannot be controlled.
    """

    prefix = "vehicle."

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

    def check_together(self) -> None:
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
            said = f"{len(self.rotor_spin)} signs for {self.n_rotors} rotors, one each is needed"
            raise UsageError(f"vehicle.rotor_spin: {said}")
        if set(self.rotor_spin) - {1.0, -1.0}:
            raise UsageError(f"vehicle.rotor_spin={list(self.rotor_spin)}: each must be 1 or -1")
        if np.linalg.matrix_rank(self.allocation, tol=1e-9) < 4:
            raise UsageError("vehicle.rotor_position: thrust and the three torques cannot be set independently")
        if not self.thrust_min < self.hover_thrust < self.thrust_max:
            plausible(self)
            allowed = f"({self.thrust_min:g}, {self.thrust_max:g}) N"
            raise UsageError(
                f"vehicle.thrust_max: hovering takes {self.hover_thrust:.3g} N per rotor, outside {allowed}"
            )

    @property
    def n_rotors(self) -> int:
        return len(self.rotor_position)

    @cached_property
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
        needed = "a blade-element model needs vehicle.rotor and vehicle.thrust_coefficient (vehicle=lei_li has them)"
        return UsageError(f"vehicle={self.name}: {needed}")

    @property
    def hover_thrust(self) -> float:
        """Thrust of one rotor in hover (N)."""
        return self.mass * self.gravity / self.n_rotors

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of all physical parameters, without the name: vehicles with equal fingerprints fly identically."""
        stated = {key: value for key, value in asdict(self).items() if key != "name" and value is not None}
        physics = {FORMER_NAMES.get(key, key): value for key, value in stated.items()}
        return sha256_of(json.dumps(physics, sort_keys=True))[:12]

    @property
    def record(self) -> dict[str, Any]:
        """What data sets and models keep of it."""
        return {"name": self.name, "fingerprint": self.fingerprint, "mass": self.mass}


class Ratio(NamedTuple):
    """value: key, number and unit, as a text. meant: another unit -> factor on the ratio, were the number in it."""

    value: str
    name: str
    number: float
    low: float
    high: float
    meant: Mapping[str, float]


def plausible(vehicle: Vehicle) -> Vehicle:
    """The same vehicle; raises UsageError where a number of it is none of a multirotor."""
    for value, name, number, low, high, meant in _ratios(vehicle):
        if not low <= number <= high:
            units = [unit for unit, factor in meant.items() if low <= number * factor <= high]
            bounds = f"at most {high:g}"
            if low:
                bounds = f"{low:g} to {high:g}"
            hint = ""
            if units:
                hint = f"; was it meant in {' or '.join(units)}?"
            raise UsageError(f"vehicle.{value}: {name} is {number:.3g}, multirotors have {bounds}{hint}")
    return vehicle


def _ratios(vehicle: Vehicle) -> Iterator[Ratio]:
    mass = vehicle.mass
    thrust = vehicle.thrust_max
    k = vehicle.thrust_coefficient
    rotor = vehicle.rotor
    arm = float(np.linalg.norm(vehicle.rotor_position, axis=1).max())
    n = len(vehicle.rotor_position)
    heavy = mass / arm**3
    name = "mass / arm^3 (kg/m^3)"
    if heavy < 5:
        cubes = {unit: factor**-3 for unit, factor in LENGTHS.items()}
        yield Ratio(f"rotor_position, an arm of {arm:.4g} m", name, heavy, 5, 5e3, cubes)
    yield Ratio(f"mass={mass:.4g} kg", name, heavy, 5, 5e3, {"g": 1e-3})
    for moment in np.linalg.eigvalsh(vehicle.inertia)[::-1]:
        if moment <= 0:
            continue
        value = f"inertia, a moment of {moment:.4g} kg m^2"
        yield Ratio(value, "moment / (mass arm^2)", moment / (mass * arm**2), 0.015, 3, MOMENTS)
    units = {"gram-force": 9.80665e-3, "mN": 1e-3, "N of all rotors": 1 / n}
    power = n * thrust / (mass * vehicle.gravity)
    yield Ratio(f"thrust_max={thrust:.4g} N per rotor", "thrust / weight", power, 0, 30, units)
    c = vehicle.torque_coefficient
    yield Ratio(f"torque_coefficient={c:.4g} m", "torque coefficient / arm", c / arm, 0, 3, LENGTHS)
    if k is not None:
        name = "largest rotor speed times arm (m/s)"
        speed = math.sqrt(thrust / k) * arm
        yield Ratio(f"thrust_coefficient={k:.4g} N s^2", name, speed, 20, 800, {"N/rpm^2": math.pi / 30})
    if rotor is not None:
        R = rotor.radius
        A = rotor.reference_area
        areas = {"cm^2": 1e-4, "mm^2": 1e-6}
        yield Ratio(f"rotor.radius={R:.4g} m", "radius / arm", R / arm, 0.05, 1.5, LENGTHS)
        yield Ratio(f"rotor.reference_area={A:.4g} m^2", "area / arm^2", A / arm**2, 0.01, 30, areas)
