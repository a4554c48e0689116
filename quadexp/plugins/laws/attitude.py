"""The attitude that a wanted force and a heading determine, with its rate, and the error of an attitude.

    z = F / |F|,   y = z x b / |z x b|,   R = [y x z, y, z]             F: world, along the rotors' axis; b: heading

Lee, Leok, McClamroch 2010, "Geometric tracking control of a quadrotor UAV on SE(3)", equations (12), (23).
"""

from __future__ import annotations

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression

SMALL = 1e-9  # of a length below which a direction is not determined: the result is finite, and means nothing


def attitude_of(force: Expression, heading: Expression) -> Expression:
    """R, (3, 3), body to world. force: (3,), world. heading: b, (3,), world, not along the force."""
    z = _direction(force)
    y = _direction(ca.cross(z, heading))
    return ca.horzcat(ca.cross(y, z), y, z)


def moving_attitude(
    force: tuple[Expression, Expression, Expression], heading: tuple[Expression, Expression, Expression]
) -> tuple[Expression, Expression, Expression]:
    """R (3, 3), its body rate w (3,) (rad/s) and w' (3,) (rad/s^2), exactly.

    force, heading: each with its first and second derivative in time, (3,), world.
    """
    t = ca.SX.sym("t")
    along = [value + t * first + t**2 / 2 * second for value, first, second in (force, heading)]
    R = ca.vec(attitude_of(*along))
    first = ca.jacobian(R, t)
    second = ca.jacobian(first, t)
    now = []
    for derivative in (R, first, second):
        value = ca.substitute(ca.densify(derivative), t, 0)
        now.append(ca.reshape(value, 3, 3))
    R, first, second = now
    return R, skew_part(R.T @ first), skew_part(R.T @ second)


def heading_of(R: Expression) -> Expression:
    """The yaw (rad) of an attitude (3, 3): y_body is level against x_C = (cos yaw, sin yaw, 0), as in flat_map.py."""
    return ca.atan2(-R[0, 1], R[1, 1])


def skew_part(matrix: Expression) -> Expression:
    """The vector v, (3,), with v x = (A - A') / 2 of a matrix A, (3, 3)."""
    twice = matrix - matrix.T
    return ca.vertcat(twice[2, 1], twice[0, 2], twice[1, 0]) / 2


def attitude_error(R: Expression, R_d: Expression) -> Expression:
    """e_R = 1/2 vee(R_d' R - R' R_d), (3,), body; the angle (rad) where it is small."""
    return skew_part(R_d.T @ R)


def attitude_distance(R: Expression, R_d: Expression) -> Expression:
    """Psi = 1/2 tr(I - R_d' R): 0 .. 2, 1 - cos of the angle between the attitudes."""
    return (3 - ca.trace(R_d.T @ R)) / 2


def _direction(vector: Expression) -> Expression:
    return vector / ca.fmax(ca.norm_2(vector), SMALL)
