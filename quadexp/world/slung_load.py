"""A payload slung on a cable: a point mass and the vehicle pull at each other.

    m v_l' = m g - F - k |v_l - w| (v_l - w)                         the load, p_l' = v_l                          world
    F = n max(0, K (l - L) + C l'),   n = (p_l - p_a) / l,   l = |p_l - p_a|          on the vehicle, at the point p_a

At rest the cable is stretched by a small share e of its length L, K = m |g| / (e L); C = 2 zeta sqrt(K m) damps it, and it
is slack when shorter than L. At rest |F| = m |g|; where the vehicle is held, the load swings with the period of a
pendulum, 2 pi sqrt(L / |g|).

F is held over a step h, at the positions that half the step leads to at the velocities of its beginning. With
p + h v + h^2 F / 2 m and v + h F / m on both sides this is the position form of Verlet's method: of second order, and
without damping it neither gains nor loses energy in the long run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from quadexp.errors import UsageError
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY

STABLE = 0.5  # largest step times angular frequency of the cable; Verlet's method is stable below 2


@dataclass(frozen=True)
class Cable:
    """mass m: kg, of the load. length L: m, unstretched. point: (3,), from the centre of mass, body (m).

    stretch e: share of L at rest. damping zeta: of the oscillation along the cable. drag k: of the load, N s^2/m^2.
    """

    mass: float
    length: float
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stretch: float = 0.002
    damping: float = 0.1
    drag: float = 0.0
    gravity: float = 9.81

    @property
    def stiffness(self) -> float:
        """K (N/m)."""
        return self.mass * self.gravity / (self.stretch * self.length)

    def check_step(self, step: float, vehicle_mass: float) -> None:
        """Raises UsageError where an integration step (s) is too long for the cable between load and vehicle (kg)."""
        frequency = math.sqrt(self.stiffness * (1 / self.mass + 1 / vehicle_mass))
        if step * frequency > STABLE:
            raise UsageError(
                f"payload: the cable oscillates along its length at {frequency:.4g} rad/s, too fast for steps of"
                f" {step:g} s: plant.step must be at most {STABLE / frequency:.2g} s, or payload.stretch larger"
            )


def hanging(cable: Cable, x: np.ndarray) -> np.ndarray:
    """[position, velocity] of the load, (6,), world: at rest beneath the vehicle in the state x (13,)."""
    anchor, velocity = (np.array(part).ravel() for part in _anchor(cable, ca.DM(x)))
    return np.concatenate([anchor - [0, 0, (1 + cable.stretch) * cable.length], velocity])


def cable_force(cable: Cable, x: Expression, load: Expression, step: Expression) -> Expression:
    """F (3,), world (N), on the vehicle in the state x (13,) by the load (6,), held over a step (s); see the module."""
    anchor, velocity = _anchor(cable, x)
    relative, rate = load[:3] - anchor, load[3:] - velocity
    ahead = relative + step / 2 * rate
    length = ca.sqrt(ca.sumsqr(ahead) + 1e-12)  # differentiable where the load meets the vehicle
    direction = ahead / length
    coefficient = 2 * cable.damping * math.sqrt(cable.stiffness * cable.mass)
    tension = cable.stiffness * (length - cable.length) + coefficient * ca.dot(direction, rate)
    return ca.if_else(length > cable.length, ca.fmax(tension, 0), 0) * direction


def cable_torque(cable: Cable, q: Expression, force: Expression) -> Expression:
    """Torque (3,), body (N m), of a force (3,), world (N), at the cable's end; q: attitude (4,), body to world."""
    return ca.cross(ca.DM(cable.point), ca.mtimes(rotation_matrix(q).T, force))


def advance(cable: Cable, load: Expression, force: Expression, wind: Expression, step: Expression) -> Expression:
    """The load (6,) after a step (s) under the held force (3,) (N) on the vehicle, and wind (3,), world (m/s)."""
    through_air = load[3:] - wind
    drag = cable.drag * ca.sqrt(ca.sumsqr(through_air) + 1e-12) * through_air
    acceleration = ca.vertcat(0, 0, -cable.gravity) - (force + drag) / cable.mass
    return ca.vertcat(load[:3] + step * load[3:] + step**2 / 2 * acceleration, load[3:] + step * acceleration)


def _anchor(cable: Cable, x: Expression) -> tuple[Expression, Expression]:
    """Position (3,) (m) and velocity (3,) (m/s), world, of the cable's end at the vehicle."""
    R, point = rotation_matrix(x[ATTITUDE]), ca.DM(cable.point)
    return x[POSITION] + ca.mtimes(R, point), x[VELOCITY] + ca.mtimes(R, ca.cross(x[RATE], point))
