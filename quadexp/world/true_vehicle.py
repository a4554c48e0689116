"""The vehicle that is flown, where it differs from the one that controllers assume.

Mass, inertia and centre of mass by factors and an offset c, then a payload of mass m at the point r:

    M' = f_M M,   J' = S J S with S = diag(sqrt(f_J))                                  at the centre of mass, moved by c
    M'' = M' + m,   c'' = (M' c + m r) / M''                                          from the assumed centre, body, m
    J'' = J' + M' [c - c''] + m [r - c''],   [d] = |d|^2 I - d d'                        Steiner's theorem
    r_i'' = r_i - c''                                                                    rotors, from the true centre

The state of a flight is that of the true centre of mass. Thrust and torque coefficients that are off by f_T and f_Q
change what a rotor gives at the thrust u_i that it is asked for, whatever the plant (the factor on drag changes the
plant itself, experiment/build.py):

    F = R e_z sum_i (f_T - 1) u_i,   tau = sum_i (r_i'' x (f_T - 1) u_i e_z + c_tau s_i (f_T f_Q - 1) u_i e_z)
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.parts.settings import Triple, key, keyed
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import along_z, rotation_matrix
from quadexp.physics.state import ATTITUDE
from quadexp.physics.vehicle import Vehicle
from quadexp.world.effect import Clock, Effect, Moment, Sizes, Start

FACTOR = "[0.1, 10]"
POINT = "[-10, 10]"
ZERO = (0.0, 0.0, 0.0)


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
    changed = {"mass": total, "inertia": tuple(map(tuple, inertia)), "rotor_position": _moved(vehicle, shift)}
    return _made(vehicle, "payload", changed)


def coefficient_allocation(vehicle: Vehicle, thrust_factor: float, torque_factor: float) -> np.ndarray:
    """Matrix of [force along z_body, tau] = matrix u, (4, n), beyond what the thrusts u (n,) (N) give without f_T, f_Q.

    vehicle: the true one.
    """
    thrust = thrust_factor - 1.0
    turn = thrust_factor * torque_factor - 1.0
    return np.array([thrust, thrust, thrust, turn])[:, None] * vehicle.allocation


@keyed
class TrueVehicle(Effect):
    """The true vehicle, by factors of the one that controllers assume.

    Parameters: coefficient_allocation (4 n,), column by column.
    """

    prefix = "truth."

    mass: float = key(1.0, "factor on the mass", FACTOR)
    inertia: Triple = key((1.0, 1.0, 1.0), "factors on the moments of inertia about x, y, z", FACTOR)
    center_of_mass: Triple = key(
        ZERO, "where the true centre of mass lies from the assumed one, body; rotors stay", "[-1, 1]", "m"
    )
    thrust_coefficient: float = key(1.0, "factor on the thrust that a rotor gives at a command", FACTOR)
    torque_coefficient: float = key(1.0, "factor on the reaction torque per thrust", "[0, 10]")
    drag: float = key(
        1.0, "factor on the plant's drag coefficients and lift; for plant=simplified and its presets", "[0, 10]"
    )

    stage = "truth"

    def true_vehicle(self, vehicle: Vehicle) -> Vehicle:
        return with_factors(vehicle, self.mass, np.array(self.inertia), np.array(self.center_of_mass))

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        return Sizes(parameters=4 * vehicle.n_rotors)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        factors = self.thrust_coefficient, self.torque_coefficient
        return (), coefficient_allocation(start.vehicle, *factors).ravel(order="F")

    def wrench(self, at: Moment) -> tuple[Expression, Expression]:
        wrench = ca.reshape(at.parameters, 4, at.thrust.numel()) @ at.thrust
        return rotation_matrix(at.x[ATTITUDE]) @ along_z(wrench[0]), wrench[1:]

    @property
    def idle(self) -> bool:
        factors = (self.mass, *self.inertia, self.thrust_coefficient, self.torque_coefficient, self.drag)
        return set(factors) == {1.0} and not any(self.center_of_mass)


@keyed
class Payload(Effect):
    """A point mass that the vehicle carries."""

    prefix = "payload."

    mass: float = key(0.2, "mass of the payload", "[0.001, 100]", "kg")
    point: Triple = key(
        ZERO, "where it is fixed, or its cable, from the true vehicle's centre of mass, body", POINT, "m"
    )


@keyed
class FixedPayload(Payload):
    """A payload fixed to the airframe."""

    stage = "truth"

    @property
    def part(self) -> str:
        return "payload"

    def true_vehicle(self, vehicle: Vehicle) -> Vehicle:
        return with_payload(vehicle, self.mass, np.array(self.point))


def _moved(vehicle: Vehicle, shift: np.ndarray) -> tuple[tuple[float, ...], ...]:
    """Rotor positions from a centre of mass that has moved by shift (3,), body (m)."""
    return tuple(map(tuple, np.array(vehicle.rotor_position, float) - shift))


def _steiner(d: np.ndarray) -> np.ndarray:
    return d @ d * np.eye(3) - np.outer(d, d)


def _made(vehicle: Vehicle, group: str, changed: dict[str, Any]) -> Vehicle:
    try:
        return replace(vehicle, **changed)
    except UsageError as error:
        raise UsageError(f"{group}: gives no vehicle that can fly: {error}") from None
