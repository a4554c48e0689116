"""A payload slung on a cable: a point mass and the vehicle pull at each other.

    m v_l' = m g - F - k |v_l - w| (v_l - w)                         the load, p_l' = v_l                          world
    F = n max(0, K (l - L) + C l'),   n = (p_l - p_a) / l,   l = |p_l - p_a|          on the vehicle, at the point p_a

At rest the cable is stretched by a small share e of its length L, K = m |g| / (e L), C = 2 zeta sqrt(K m), and
|F| = m |g|; shorter than L it is slack. Where the vehicle is held, the load swings with the period of a pendulum,
2 pi sqrt(L / |g|).

F is held over a step h, at the positions that half the step leads to at the velocities of its beginning. With
p + h v + h^2 F / 2 m and v + h F / m on both sides this is the position form of Verlet's method: of second order, and
without damping it neither gains nor loses energy in the long run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import along_z, rotation_matrix
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.world.effect import Clock, Moment, Sizes, Start
from quadexp.world.true_vehicle import Payload, with_payload

STABLE = 0.5  # largest step times angular frequency of the cable; Verlet's method is stable below 2


class Cable(NamedTuple):
    """mass m: kg, of the load. length L: m, unstretched. point: (3,), from the centre of mass, body (m).

    stiffness K: N/m. damping C: N s/m. drag k: of the load, N s^2/m^2. gravity |g|: m/s^2. Numbers or expressions.
    """

    mass: Any
    length: Any
    point: Any
    stiffness: Any
    damping: Any
    drag: Any
    gravity: Any


def cable(keys: SlungLoad, gravity: float) -> Cable:
    """The cable that some settings describe, under gravity (m/s^2)."""
    stiffness = keys.mass * gravity / (keys.stretch * keys.length)
    damping = 2 * keys.damping * math.sqrt(stiffness * keys.mass)
    return Cable(keys.mass, keys.length, keys.point, stiffness, damping, keys.drag, gravity)


def check_step(cable: Cable, step: float, vehicle_mass: float) -> None:
    """Raises UsageError where an integration step (s) is too long for the cable between load and vehicle (kg)."""
    frequency = math.sqrt(cable.stiffness * (1 / cable.mass + 1 / vehicle_mass))
    if step * frequency > STABLE:
        raise UsageError(
            f"payload: the cable oscillates along its length at {frequency:.4g} rad/s, too fast for steps of {step:g}"
            f" s: plant.step must be at most {STABLE / frequency:.2g} s, or payload.stretch larger"
        )


def hanging(cable: Cable, x: np.ndarray) -> np.ndarray:
    """[position, velocity] of the load, (6,), world: at rest beneath the vehicle in the state x (13,)."""
    anchor, velocity = _anchor(cable, ca.DM(x))
    stretch = cable.mass * cable.gravity / cable.stiffness
    load = anchor - along_z(cable.length + stretch)
    return np.array(ca.vertcat(load, velocity)).ravel()


def cable_force(cable: Cable, x: Expression, load: Expression, step: Expression) -> Expression:
    """F (3,), world (N), on the vehicle in the state x (13,) by the load (6,), held over a step (s); see the module."""
    anchor, velocity = _anchor(cable, x)
    relative = load[:3] - anchor
    rate = load[3:] - velocity
    ahead = relative + step / 2 * rate
    length = ca.sqrt(ca.sumsqr(ahead) + 1e-12)  # differentiable where the load meets the vehicle
    direction = ahead / length
    tension = cable.stiffness * (length - cable.length)
    tension += cable.damping * ca.dot(direction, rate)
    pull = ca.if_else(length > cable.length, ca.fmax(tension, 0), 0)
    return pull * direction


def cable_torque(cable: Cable, q: Expression, force: Expression) -> Expression:
    """Torque (3,), body (N m), of a force (3,), world (N), at the cable's end; q: attitude (4,), body to world."""
    return ca.cross(_vector(cable.point), rotation_matrix(q).T @ force)


def advanced(cable: Cable, load: Expression, force: Expression, wind: Expression, step: Expression) -> Expression:
    """The load (6,) after a step (s) under the held force (3,) (N) on the vehicle, and wind (3,), world (m/s)."""
    through_air = load[3:] - wind
    drag = cable.drag * ca.sqrt(ca.sumsqr(through_air) + 1e-12) * through_air
    acceleration = along_z(-cable.gravity) - (force + drag) / cable.mass
    velocity = load[3:]
    position = load[:3] + step * velocity + step**2 / 2 * acceleration
    return ca.vertcat(position, velocity + step * acceleration)


def _anchor(cable: Cable, x: Expression) -> tuple[Expression, Expression]:
    """Position (3,) (m) and velocity (3,) (m/s), world, of the cable's end at the vehicle."""
    R = rotation_matrix(x[ATTITUDE])
    point = _vector(cable.point)
    return x[POSITION] + R @ point, x[VELOCITY] + R @ ca.cross(x[RATE], point)


def _vector(values: Any) -> Expression:
    if isinstance(values, tuple):
        return ca.DM(values)
    return values


@keyed
class SlungLoad(Payload):
    """A point mass on a cable.

    Inner: position (3,) (m) and velocity (3,) (m/s) of the load, world. parameters: of its Cable.

    Raises UsageError where the vehicle cannot carry it, and at the start of a flight whose integration steps are too
    long for the cable.
    """

    length: float = key(1.0, "length of the cable, unstretched", "[0.05, 100]", "m")
    stretch: float = key(0.002, "share of its length that the payload at rest stretches the cable", "[1e-5, 0.5]")
    damping: float = key(0.1, "damping ratio of the oscillation along the cable", "[0, 2]")
    drag: float = key(0.0, "drag of the payload per velocity squared", "[0, 100]", "N s^2/m^2")

    stage = "external"

    @property
    def part(self) -> str:
        return "payload"

    def true_vehicle(self, vehicle: Vehicle) -> Vehicle:
        """The vehicle itself, if it can hover with the load."""
        with_payload(vehicle, self.mass, np.zeros(3))
        return vehicle

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        return Sizes(inner=6, parameters=9)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        """The load hangs at rest."""
        rope = cable(self, start.vehicle.gravity)
        check_step(rope, start.clock.step, start.vehicle.mass)
        return hanging(rope, start.x), np.hstack(rope)

    def columns(self, clock: Clock, vehicle: Vehicle) -> Mapping[str, int]:
        return {f"load_{axis}": i for i, axis in enumerate("xyz")}

    def wrench(self, at: Moment) -> tuple[Expression, Expression]:
        rope = self._cable(at)
        force = cable_force(rope, at.x, at.inner, at.step)
        return force, cable_torque(rope, at.x[ATTITUDE], force)

    def advance(self, at: Moment) -> Expression:
        rope = self._cable(at)
        force = cable_force(rope, at.x, at.inner, at.step)
        return advanced(rope, at.inner, force, at.wind, at.step)

    @staticmethod
    def _cable(at: Moment) -> Cable:
        mass, length, point, *others = ca.vertsplit(at.parameters, [0, 1, 2, 5, 6, 7, 8, 9])
        return Cable(mass, length, point, *others)
