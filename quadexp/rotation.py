"""Quaternion kinematics as CasADi expressions (Hamilton, body to world, w first).

    R(q) rotates body vectors into the world;   q' = 1/2 q o [0, w]   with w the body rate (rad/s).

Post-processing in numpy uses scipy.spatial.transform.Rotation instead.
"""

from __future__ import annotations

import casadi as ca

from quadexp.expression import Expression


def rotation_matrix(q: Expression) -> Expression:
    """Rotation matrix R(q), (3, 3), of a quaternion q, (4,), of any length but zero: that of q / |q|.

    Within an integration step, and at the nodes of a prediction, q is of length one only nearly. The form that divides
    by q'q stays a rotation there, and turns with the world as it should: R(p o q) = R(p) R(q).
    """
    w, x, y, z = q[0], q[1], q[2], q[3]
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    double = 2 / (ww + xx + yy + zz)
    return ca.vertcat(
        ca.horzcat(1 - double * (yy + zz), double * (x * y - w * z), double * (x * z + w * y)),
        ca.horzcat(double * (x * y + w * z), 1 - double * (xx + zz), double * (y * z - w * x)),
        ca.horzcat(double * (x * z - w * y), double * (y * z + w * x), 1 - double * (xx + yy)),
    )


def left_matrix(q: Expression) -> Expression:
    """L(q), (4, 4), of the Hamilton product: L(q) p = q o p. Orthogonal where q is a unit quaternion."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ca.vertcat(
        ca.horzcat(w, -x, -y, -z),
        ca.horzcat(x, w, -z, y),
        ca.horzcat(y, z, w, -x),
        ca.horzcat(z, -y, x, w),
    )


def quaternion_rate(q: Expression, w: Expression) -> Expression:
    """Time derivative of the quaternion, (4,) (1/s), under the body rate w, (3,) (rad/s)."""
    return 0.5 * ca.mtimes(left_matrix(q)[:, 1:], w)
