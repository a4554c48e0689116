"""Rotation vectors and quaternions, as filters of navigation need them."""

from __future__ import annotations

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import SMALLEST


def conjugate(q: Expression) -> Expression:
    """q*, (4,): the inverse of a unit quaternion."""
    return ca.vertcat(q[0], -q[1:])


def cross_matrix(v: Expression) -> Expression:
    """[v]x, (3, 3), with [v]x u = v x u."""
    return ca.vertcat(ca.horzcat(0, -v[2], v[1]), ca.horzcat(v[2], 0, -v[0]), ca.horzcat(-v[1], v[0], 0))


def logarithm(q: Expression) -> Expression:
    """Log(q), the rotation vector (3,) (rad) of the shorter way round of a unit quaternion."""
    length = ca.sqrt(ca.sumsqr(q[1:]) + SMALLEST)
    return ca.if_else(q[0] < 0, -1, 1) * 2 * ca.atan2(length, abs(q[0])) / length * q[1:]


def right_jacobian(phi: Expression) -> Expression:
    """J_r(phi), (3, 3): Exp(phi + d) = Exp(phi) o Exp(J_r d) to first order in d."""
    square = ca.sumsqr(phi) + SMALLEST
    angle = ca.sqrt(square)
    cross = cross_matrix(phi)
    near = square < 1e-4  # where the quotients lose their digits, their series
    first = ca.if_else(near, 1 / 2 - square / 24, 2 * ca.sin(angle / 2) ** 2 / square)
    second = ca.if_else(near, 1 / 6 - square / 120, (angle - ca.sin(angle)) / (angle * square))
    return ca.DM.eye(3) - first * cross + second * (cross @ cross)
