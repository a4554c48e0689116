"""Random states for property-like tests."""

from dataclasses import replace

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.papers.lei_li.feedback.frames import FRD_FLU, NED_ENU, euler_angles


def random_state(rng: np.random.Generator, *, speed: float = 6.0, rate: float = 3.0) -> np.ndarray:
    """Any state: random attitude, velocity and rate."""
    q = rng.normal(size=4)
    return np.concatenate(
        [rng.normal(size=3), q / np.linalg.norm(q), speed * rng.normal(size=3), rate * rng.normal(size=3)]
    )


def with_rotor_count(vehicle: Vehicle, rotors: int) -> Vehicle:
    """The vehicle with so many rotors on an ellipse, turning either way."""
    angle = 2 * np.pi * (np.arange(rotors) + 0.3) / rotors
    place = np.stack([0.2 * np.cos(angle), 0.17 * np.sin(angle), 0 * angle], axis=1)
    spin = tuple(1 - 2 * (i % 2) for i in range(rotors))
    return replace(vehicle, rotor_position=tuple(map(tuple, place)), rotor_spin=spin)


def ned_from_state(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """xi (3,) NED (m), eta (3,) (rad), velocity (3,) NED (m/s), Omega (3,) FRD (rad/s) of a state (13,)."""
    R = NED_ENU @ Rotation.from_quat(x[ATTITUDE], scalar_first=True).as_matrix() @ FRD_FLU
    eta = ca.DM(euler_angles(ca.DM(R))).full().ravel()
    return NED_ENU @ x[POSITION], eta, NED_ENU @ x[VELOCITY], FRD_FLU @ x[RATE]
