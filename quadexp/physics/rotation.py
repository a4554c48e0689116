"""Quaternion kinematics as CasADi expressions (Hamilton, body to world, w first).

    R(q) rotates body vectors into the world;   q' = 1/2 q o [0, w]   with w the body rate (rad/s).

Rotation vectors follow Solà 2017, "Quaternion kinematics for the error-state Kalman filter" (arXiv:1711.02508).

Post-processing in numpy uses scipy.spatial.transform.Rotation instead, except for the velocity relative to the air,
which is computed here both for expressions and for samples, and for headings.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression, unit
from quadexp.physics.state import ATTITUDE

SMALLEST = 1e-30  # rad^2, floor under the square of an angle that keeps its root and quotients finite


def rotation_matrix(q: Expression) -> Expression:
    """Rotation matrix R(q), (3, 3), of a quaternion q, (4,), of any non-zero length: that of q / |q|.

    Within an integration step, and at the nodes of a prediction, q is only approximately of unit length. Dividing by
    q'q keeps R a rotation there, with R(p o q) = R(p) R(q).
    """
    rows = _entries(q[0], q[1], q[2], q[3])
    return ca.blockcat([list(row) for row in rows])


def with_unit_attitude(x: Expression) -> Expression:
    """A state, and what stands behind it, with its quaternion brought back to unit length."""
    return ca.vertcat(x[: ATTITUDE.start], unit(x[ATTITUDE]), x[ATTITUDE.stop :])


def along_z(size: Expression) -> Expression:
    """The vector of this size along z, (3,)."""
    return ca.vertcat(0, 0, size)


def air_velocity(q: Any, velocity: Any, wind: Any = None) -> Any:
    """Velocity relative to the air in body axes, R(q)' (v - wind), on which all aerodynamic forces depend.

    q: (4,), body to world. velocity, wind: (3,), world (m/s); None: still air. CasADi expressions, or numpy arrays of
    samples (..., 4), (..., 3). Returns (3,), or (..., 3) (m/s).
    """
    if wind is not None:
        velocity = velocity - wind
    if not isinstance(q, np.ndarray):
        return rotation_matrix(q).T @ velocity
    if q.ndim == 1:  # Python floats are several times faster than numpy scalars
        rows = _entries(*q.tolist())
        x, y, z = velocity.tolist()
    else:
        rows = _entries(*np.moveaxis(q, -1, 0))
        x, y, z = np.moveaxis(velocity, -1, 0)
    body = [a * x + b * y + c * z for a, b, c in zip(*rows, strict=True)]
    return np.stack(body, axis=-1)


def heading(q: np.ndarray) -> np.ndarray:
    """The heading that a yaw prescribes, (...) (rad): y_body is level against (cos yaw, sin yaw, 0), of q, (..., 4)."""
    rows = _entries(*np.moveaxis(q, -1, 0))
    return np.asarray(np.arctan2(-rows[0][1], rows[1][1]))


def thrust_axis(q: np.ndarray) -> np.ndarray:
    """z_body in the world, (..., 3), of q, (..., 4)."""
    rows = _entries(*np.moveaxis(q, -1, 0))
    return np.stack([row[2] for row in rows], axis=-1)


def heading_rate(q: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Time derivative of `heading`, (...) (rad/s), under the body rate w, (..., 3) (rad/s)."""
    (x_0, y_0, z_0), (x_1, y_1, z_1), _ = _entries(*np.moveaxis(q, -1, 0))
    roll, _, yaw = np.moveaxis(w, -1, 0)
    y_0_dot = z_0 * roll - x_0 * yaw
    y_1_dot = z_1 * roll - x_1 * yaw
    turn = y_0 * y_1_dot - y_1 * y_0_dot
    return np.asarray(turn / np.maximum(y_0**2 + y_1**2, SMALLEST))


def _entries(w: Any, x: Any, y: Any, z: Any) -> tuple[tuple[Any, Any, Any], ...]:
    """Rows of R; floats, arrays or expressions."""
    ww = w * w
    xx = x * x
    yy = y * y
    zz = z * z
    double = 2 / (ww + xx + yy + zz)
    return (
        (1 - double * (yy + zz), double * (x * y - w * z), double * (x * z + w * y)),
        (double * (x * y + w * z), 1 - double * (xx + zz), double * (y * z - w * x)),
        (double * (x * z - w * y), double * (y * z + w * x), 1 - double * (xx + yy)),
    )


def left_matrix(q: Expression) -> Expression:
    """L(q), (4, 4), of the Hamilton product: L(q) p = q o p. Orthogonal where q is a unit quaternion."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return ca.blockcat([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def right_matrix(q: Expression) -> Expression:
    """M(q), (4, 4), of the Hamilton product: M(q) p = p o q. Orthogonal where q is a unit quaternion."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return ca.blockcat([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])


def quaternion_rate(q: Expression, w: Expression) -> Expression:
    """Time derivative of the quaternion, (4,) (1/s), under the body rate w, (3,) (rad/s)."""
    return 0.5 * (left_matrix(q)[:, 1:] @ w)


def product(p: Expression, q: Expression) -> Expression:
    """Hamilton product p o q, (4,)."""
    return left_matrix(p) @ q


def exponential(phi: Expression) -> Expression:
    """Exp(phi), the unit quaternion (4,) of a rotation vector (3,) (rad)."""
    half = ca.sqrt(ca.sumsqr(phi) + SMALLEST) / 2
    return ca.vertcat(ca.cos(half), ca.sin(half) / (2 * half) * phi)


def continuous(q: np.ndarray) -> np.ndarray:
    """Quaternions (k, 4) with the sign of each chosen to lie on the side of the one before."""
    flips = np.sum(q[1:] * q[:-1], axis=1) < 0
    later = np.where(np.cumsum(flips) % 2, -1.0, 1.0)
    sign = np.concatenate([[1.0], later])
    return q * sign[:, None]
