"""Flatness under rotor drag in closed form (Faessler, Franchi & Scaramuzza 2018, RA-L 3(2), equations 13-40).

    a = g + c z_B - R D R^T v,    D = diag(d_x, d_y, d_z) (1/s),    T = m c

Projecting on the body axes, with alpha = a - g + d_x v and beta = a - g + d_y v:

    y_B = beta x x_C / |.|,    x_B = y_B x alpha / |.|,    z_B = x_B x y_B,    c = z_B . (a - g + d_z v)

(the paper levels x_B against y_C; here y_B is level against x_C, as in flatness.py.) With v, a, j, s and the heading
h = R^T x_C, e = R^T y_C in body axes, f = R^T (a - g), differentiating once and twice gives for the rates and for the
angular accelerations

    [w x f + D (w x v)]_xy   = [j + D a]_xy,                                    (w x h)_y  = yaw' e_y
    [w' x f + D (w' x v)]_xy = [s - w x j + D (j - w x a)
                                - w x (j - w x f) - D (w x (a - w x v))]_xy,    (w' x h)_y = yaw'' e_y
                                                                    - 2 yaw' (w x e)_y + (w x (w x h))_y

Analytic to the last term: it needs no iteration, and holds the general fixed point to account.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.physics.vehicle import Vehicle
from quadexp.reference.base import Trajectory
from quadexp.reference.flatness import Reference, continuous
from quadexp.reference.motion import rotor_thrusts


def rotor_drag_reference(trajectory: Trajectory, t: np.ndarray, vehicle: Vehicle, drag: Sequence[float]) -> Reference:
    """Reference states and inputs under linear rotor drag.

    t: (k,), s; outside 0 .. trajectory.duration the end is held. drag: d_x, d_y, d_z, (3,), 1/s.
    A free heading has no closed form.
    """
    t = np.atleast_1d(np.asarray(t, float))
    d = np.asarray(drag, float)
    flat = trajectory.flat_output(t)
    velocity, acceleration, jerk, snap = flat.position[:, 1:].transpose(1, 0, 2)
    force = acceleration + [0.0, 0.0, vehicle.gravity]
    yaw, yaw_rate, yaw_acceleration = flat.yaw.T
    zero = np.zeros_like(yaw)
    x_c = np.stack([np.cos(yaw), np.sin(yaw), zero], axis=1)
    y_c = np.stack([-np.sin(yaw), np.cos(yaw), zero], axis=1)

    y_b = _unit(np.cross(force + d[1] * velocity, x_c))
    x_b = _unit(np.cross(y_b, force + d[0] * velocity))
    z_b = np.cross(x_b, y_b)
    rotation = np.stack([x_b, y_b, z_b], axis=2)
    v, a, j, s, f, h, e = (
        np.einsum("kij,ki->kj", rotation, vector) for vector in (velocity, acceleration, jerk, snap, force, x_c, y_c)
    )
    collective = f[:, 2] + d[2] * v[:, 2]

    # [w x f + D (w x v)]_xy and (w x h)_y as a matrix on w: rows of w -> w x b are -[b]_x
    system = -_skew(f) - d[:, None] * _skew(v)
    system[:, 2] = -_skew(h)[:, 1]
    right = j + d * a
    right[:, 2] = yaw_rate * e[:, 1]
    w = np.linalg.solve(system, right[..., None])[..., 0]
    right = (
        s
        - np.cross(w, j)
        + d * (j - np.cross(w, a))
        - np.cross(w, j - np.cross(w, f))
        - d * np.cross(w, a - np.cross(w, v))
    )
    right[:, 2] = yaw_acceleration * e[:, 1] - 2 * yaw_rate * np.cross(w, e)[:, 1] + np.cross(w, np.cross(w, h))[:, 1]
    w_dot = np.linalg.solve(system, right[..., None])[..., 0]
    thrusts = rotor_thrusts(vehicle, vehicle.mass * collective, w.T, w_dot.T, np.zeros_like(w.T)).T
    quaternion = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    state = np.concatenate([flat.position[:, 0], continuous(quaternion), velocity, w], axis=1)
    return Reference(t, state, thrusts)


def _unit(vector: np.ndarray) -> np.ndarray:
    """Vectors (k, 3) at length one."""
    return vector / np.linalg.norm(vector, axis=1, keepdims=True)


def _skew(b: np.ndarray) -> np.ndarray:
    """[b]_x, (k, 3, 3): [b]_x c = b x c."""
    x, y, z = b.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
