"""Quaternion kinematics as CasADi expressions (Hamilton, body to world, w first).

    R(q) rotates body vectors into the world;   q' = 1/2 q o [0, w]   with w the body rate (rad/s).

Post-processing in numpy uses scipy.spatial.transform.Rotation instead.
"""

from __future__ import annotations

import casadi as ca

from quadexp.expression import Expression


def rotation_matrix(q: Expression) -> Expression:
    """Rotation matrix R(q), (3, 3), of a unit quaternion q, (4,)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def quaternion_rate(q: Expression, w: Expression) -> Expression:
    """Time derivative of the quaternion, (4,) (1/s), under the body rate w, (3,) (rad/s)."""
    return 0.5 * ca.vertcat(
        -q[1] * w[0] - q[2] * w[1] - q[3] * w[2],
        q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
        q[0] * w[1] - q[1] * w[2] + q[3] * w[0],
        q[0] * w[2] + q[1] * w[1] - q[2] * w[0],
    )
