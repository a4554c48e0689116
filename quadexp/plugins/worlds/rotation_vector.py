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
    x = v[0]
    y = v[1]
    z = v[2]
    return ca.blockcat([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def logarithm(q: Expression) -> Expression:
    """Log(q), the rotation vector (3,) (rad) of the shorter way round of a unit quaternion."""
    length = ca.sqrt(ca.sumsqr(q[1:]) + SMALLEST)
    shorter = ca.if_else(q[0] < 0, -1, 1)
    return shorter * 2 * ca.atan2(length, abs(q[0])) / length * q[1:]


def right_jacobian(phi: Expression) -> Expression:
    """J_r(phi), (3, 3): Exp(phi + d) = Exp(phi) o Exp(J_r d) to first order in d."""
    square = ca.sumsqr(phi) + SMALLEST
    angle = ca.sqrt(square)
    cross = cross_matrix(phi)
    near = square < 1e-4  # where the quotients lose their digits, their series
    first = 2 * ca.sin(angle / 2) ** 2 / square
    second = (angle - ca.sin(angle)) / (angle * square)
    first = ca.if_else(near, 1 / 2 - square / 24, first)
    second = ca.if_else(near, 1 / 6 - square / 120, second)
    return ca.DM.eye(3) - first * cross + second * (cross @ cross)
