"""Quaternion kinematics as CasADi expressions (Hamilton, body to world, w first).

    R(q) rotates body vectors into the world;   q' = 1/2 q o [0, w]   with w the body rate (rad/s).

Post-processing in numpy uses scipy.spatial.transform.Rotation instead, except for the velocity relative to the air,
which is computed here both for expressions and for samples.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from quadexp.physics.expression import Expression


def rotation_matrix(q: Expression) -> Expression:
    """Rotation matrix R(q), (3, 3), of a quaternion q, (4,), of any non-zero length: that of q / |q|.

    Within an integration step, and at the nodes of a prediction, q is only approximately of unit length. Dividing by
    q'q keeps R a rotation there, with R(p o q) = R(p) R(q).
    """
    return ca.vertcat(*(ca.horzcat(*row) for row in _entries(q[0], q[1], q[2], q[3])))


def air_velocity(q: Any, velocity: Any, wind: Any = None) -> Any:
    """Velocity relative to the air in body axes, R(q)' (v - wind), on which all aerodynamic forces depend.

    q: (4,), body to world. velocity, wind: (3,), world (m/s); None: still air. CasADi expressions, or numpy arrays of
    samples (..., 4), (..., 3). Returns (3,), or (..., 3) (m/s).
    """
    relative = velocity if wind is None else velocity - wind
    if not isinstance(q, np.ndarray):
        return ca.mtimes(rotation_matrix(q).T, relative)
    single = q.ndim == 1  # Python floats are several times faster than numpy scalars
    rows = _entries(*(q.tolist() if single else np.moveaxis(q, -1, 0)))
    x, y, z = relative.tolist() if single else np.moveaxis(relative, -1, 0)
    return np.stack([rows[0][i] * x + rows[1][i] * y + rows[2][i] * z for i in range(3)], axis=-1)


def _entries(w: Any, x: Any, y: Any, z: Any) -> tuple[tuple[Any, Any, Any], ...]:
    """Rows of R; floats, arrays or expressions."""
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    double = 2 / (ww + xx + yy + zz)
    return (
        (1 - double * (yy + zz), double * (x * y - w * z), double * (x * z + w * y)),
        (double * (x * y + w * z), 1 - double * (xx + zz), double * (y * z - w * x)),
        (double * (x * z - w * y), double * (y * z + w * x), 1 - double * (xx + yy)),
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
