"""Ground effect: a rotor near the ground gives more thrust (Cheeseman & Bennett 1955, hovering flight).

    T / T_free = 1 / (1 - (R / 4 z)^2)                     z: height of the rotor over the ground, R: its radius

The formula is valid down to z = R / 2 about and grows without limit towards z = R / 4, so z is taken as R / 2 at least
(a factor f of 4/3). Above a height f is taken as 1. What a rotor gives more, (f - 1) u at the thrust u that it is asked
for, acts along z_body at the rotor; its speed does not change.
"""

from __future__ import annotations

import casadi as ca

from quadexp.physics.expression import Expression
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, POSITION
from quadexp.physics.vehicle import Vehicle

LEAST_HEIGHT = 0.5  # radii


def thrust_factor(height: Expression, radius: float) -> Expression:
    """T / T_free at a height (m) of the rotor, of any shape; radius: m."""
    return 1 / (1 - (radius / (4 * ca.fmax(height, LEAST_HEIGHT * radius))) ** 2)


def ground_wrench(
    vehicle: Vehicle, x: Expression, thrust: Expression, radius: float, ground: float, height_max: float
) -> tuple[Expression, Expression]:
    """Force (3,), world (N), and torque (3,), body (N m), beyond what the thrusts (n,) (N) give far from the ground.

    x: state (13,). radius: m, of a rotor. ground: its height, world (m). height_max: m, of a rotor
    over the ground, above which there is no effect.
    """
    R = rotation_matrix(x[ATTITUDE])
    position = ca.DM(vehicle.rotor_position)  # (n, 3)
    height = x[POSITION][2] - ground + ca.mtimes(position, R[2, :].T)
    added = ca.if_else(height < height_max, thrust_factor(height, radius) - 1, 0) * thrust
    wrench = ca.mtimes(ca.DM(vehicle.allocation), added)
    return ca.mtimes(R, ca.vertcat(0, 0, wrench[0])), ca.vertcat(wrench[1], wrench[2], 0)
