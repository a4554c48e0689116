"""The vehicle that is flown, where it differs from the one that controllers believe in.

Mass, inertia and centre of mass by factors and an offset c, then a payload of mass m at the point r:

    M' = f_M M,   J' = S J S with S = diag(sqrt(f_J))                                   at the centre of mass, moved by c
    M'' = M' + m,   c'' = (M' c + m r) / M''                                           from the believed centre, body, m
    J'' = J' + M' [c - c''] + m [r - c''],   [d] = |d|^2 I - d d'                         Steiner's theorem
    r_i'' = r_i - c''                                                                     rotors, from the true centre

The state of a flight is that of the true centre of mass. Thrust and torque coefficients that are off by f_T and f_Q
change what a rotor gives at the thrust u_i that it is asked for, whatever the plant:

    F = R e_z sum_i (f_T - 1) u_i,   tau = sum_i (r_i'' x (f_T - 1) u_i e_z + c_tau s_i (f_T f_Q - 1) u_i e_z)
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from quadexp.errors import UsageError
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.vehicle import Vehicle


def with_factors(vehicle: Vehicle, mass: float, inertia: np.ndarray, center_of_mass: np.ndarray) -> Vehicle:
    """The vehicle with f_M, f_J (3,) and c (3,), body (m).

    Raises UsageError where that is no vehicle that can hover.
    """
    root = np.sqrt(np.asarray(inertia, float))
    changed = {
        "mass": mass * vehicle.mass,
        "inertia": tuple(map(tuple, root[:, None] * vehicle.inertia_matrix * root)),
        "rotor_position": _moved(vehicle, np.asarray(center_of_mass, float)),
    }
    return _made(vehicle, "truth", changed)


def with_payload(vehicle: Vehicle, payload: float, point: np.ndarray) -> Vehicle:
    """The vehicle with a point mass (kg) fixed at a point (3,) from its centre of mass, body (m).

    Raises UsageError where the vehicle cannot hover with it.
    """
    total = vehicle.mass + payload
    shift = payload / total * np.asarray(point, float)
    inertia = vehicle.inertia_matrix + vehicle.mass * _steiner(shift) + payload * _steiner(point - shift)
    changed = {
        "mass": total,
        "inertia": tuple(map(tuple, inertia)),
        "rotor_position": _moved(vehicle, shift),
    }
    return _made(vehicle, "payload", changed)


def coefficient_wrench(
    vehicle: Vehicle, q: Expression, thrust: Expression, thrust_factor: float, torque_factor: float
) -> tuple[Expression, Expression]:
    """Force (3,), world (N), and torque (3,), body (N m), beyond what the thrusts (n,) (N) give without f_T and f_Q.

    vehicle: the true one. q: attitude (4,), body to world.
    """
    lever = thrust_factor - 1.0
    turn = thrust_factor * torque_factor - 1.0
    wrench = ca.mtimes(ca.DM(np.array([lever, lever, lever, turn])[:, None] * vehicle.allocation), thrust)
    return ca.mtimes(rotation_matrix(q), ca.vertcat(0, 0, wrench[0])), wrench[1:]


def _moved(vehicle: Vehicle, shift: np.ndarray) -> tuple[tuple[float, ...], ...]:
    """Rotor positions from a centre of mass that has moved by shift (3,), body (m)."""
    return tuple(map(tuple, np.array(vehicle.rotor_position, float) - shift))


def _steiner(d: np.ndarray) -> np.ndarray:
    return d @ d * np.eye(3) - np.outer(d, d)


def _made(vehicle: Vehicle, group: str, changed: dict[str, object]) -> Vehicle:
    try:
        return replace(vehicle, **changed)  # type: ignore[arg-type]
    except UsageError as error:
        raise UsageError(f"{group}: gives no vehicle that can fly: {error}") from None
