"""Ground effect: a rotor near the ground gives more thrust (Cheeseman & Bennett 1955, hovering flight).

    T / T_free = 1 / (1 - (R / 4 z)^2)                     z: height of the rotor over the ground, R: its radius

The formula is valid down to z = R / 2 about and grows without limit towards z = R / 4, so z is taken as R / 2 at least
(a factor f of 4/3). Above a height f is taken as 1. What a rotor gives more, (f - 1) u at the thrust u that it is asked
for, acts along z_body at the rotor; its speed does not change.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import along_z, rotation_matrix
from quadexp.physics.state import ATTITUDE, POSITION
from quadexp.physics.vehicle import Vehicle
from quadexp.world.effect import Clock, Effect, Moment, Sizes, Start

LEAST_HEIGHT = 0.5  # radii


def thrust_factor(height: Expression, radius: Expression) -> Expression:
    """T / T_free at a height (m) of the rotor, of any shape; radius: m."""
    return 1 / (1 - (radius / (4 * ca.fmax(height, LEAST_HEIGHT * radius))) ** 2)


def ground_wrench(
    x: Expression, thrust: Expression, position: Expression, radius: Expression, ground: Expression, limit: Expression
) -> tuple[Expression, Expression]:
    """Force (3,), world (N), and torque (3,), body (N m), beyond what the thrusts (n,) (N) give far from the ground.

    x: state (13,). position: of the rotors, (3, n), body (m). radius: of a rotor (m). ground: its height, world (m).
    limit: height of a rotor over the ground (m) above which there is no effect.
    """
    R = rotation_matrix(x[ATTITUDE])
    height = x[POSITION][2] - ground + (R[2, :] @ position).T
    share = ca.if_else(height < limit, thrust_factor(height, radius) - 1, 0)
    added = share * thrust
    roll = ca.dot(position[1, :].T, added)
    pitch = ca.dot(position[0, :].T, added)
    torque = ca.vertcat(roll, -pitch, 0)
    return R @ along_z(ca.sum1(added)), torque


@keyed
class GroundEffect(Effect):
    """The ground beneath the rotors.

    Parameters: positions of the rotors (3 n,), radius, height of the ground, limit of height (m).

    Raises UsageError at the beginning of a flight where no radius is known.
    """

    prefix = "ground."

    height: float = key(0.0, "height of the ground, world", "[-1000, 1000]", "m")
    height_max: float = key(
        2.0, "height of a rotor over the ground above which the ground has no effect", "(0, 1000]", "m"
    )
    rotor_radius: float | None = key(None, "radius of a rotor; null: vehicle.rotor.radius", "[0.001, 10]", "m")

    stage = "ground"

    @property
    def ground_height(self) -> float:
        """See Effect."""
        return self.height

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        return Sizes(parameters=3 * vehicle.n_rotors + 3)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        radius = self.rotor_radius
        if radius is None:
            if start.vehicle.rotor is None:
                raise UsageError(
                    f"ground.rotor_radius: needed, because vehicle={start.vehicle.name} has no vehicle.rotor (m)"
                )
            radius = start.vehicle.rotor.radius
        return (), np.concatenate([*start.vehicle.rotor_position, [radius, self.height, self.height_max]])

    def wrench(self, at: Moment) -> tuple[Expression, Expression]:
        position, *others = ca.vertsplit(at.parameters, [0, *(3 * at.thrust.numel() + i for i in range(4))])
        return ground_wrench(at.x, at.thrust, ca.reshape(position, 3, at.thrust.numel()), *others)
