"""Conversion between the paper's frames and this program's: world NED and ENU, body FRD and FLU.

    a_NED = P a_ENU,   P = [0 1 0; 1 0 0; 0 0 -1]          (x north = y, y east = x, z down = -z)
    a_FRD = F a_FLU,   F = diag(1, -1, -1)
    R (FRD to NED) = P R (FLU to ENU) F,    yaw_NED = pi/2 - yaw_ENU

P and F are their own inverses. Attitude R(phi, theta, psi) of Lei & Li 2017, equation (8): ZYX.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression, limited
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY

NED_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FLU = np.diag([1.0, -1.0, -1.0])


def yaw_ned(yaw_enu: Expression) -> Expression:
    """Heading clockwise from north (rad), of a heading counter-clockwise from east (rad); its own inverse."""
    return math.pi / 2 - yaw_enu


def rotation_euler(eta: Expression) -> Expression:
    """R(phi, theta, psi), (3, 3), FRD to NED, of eta (3,) (rad): equation (8)."""
    cp, ct, cs = (ca.cos(eta[i]) for i in range(3))
    sp, st, ss = (ca.sin(eta[i]) for i in range(3))
    return ca.vertcat(
        ca.horzcat(ct * cs, sp * st * cs - cp * ss, cp * st * cs + sp * ss),
        ca.horzcat(ct * ss, sp * st * ss + cp * cs, cp * st * ss - sp * cs),
        ca.horzcat(-st, sp * ct, cp * ct),
    )


def euler_angles(R: Expression) -> Expression:
    """eta = (phi, theta, psi), (3,) (rad), of R (3, 3), FRD to NED; theta in [-pi/2, pi/2]."""
    roll = ca.atan2(R[2, 1], R[2, 2])
    pitch = ca.asin(limited(-R[2, 0], -1.0, 1.0))
    yaw = ca.atan2(R[1, 0], R[0, 0])
    return ca.vertcat(roll, pitch, yaw)


def state_from_ned(
    position: Sequence[float], eta: Sequence[float], velocity: Sequence[float], rate: Sequence[float]
) -> np.ndarray:
    """State (13,) in ENU/FLU of a pose in NED/FRD.

    position: xi (3,) NED (m). eta: phi, theta, psi (rad). velocity: (3,) NED (m/s). rate: Omega (3,) FRD (rad/s).
    """
    x = np.empty(N_STATE)
    x[POSITION] = NED_ENU @ position
    x[VELOCITY] = NED_ENU @ velocity
    x[RATE] = FRD_FLU @ rate
    to_ned = rotation_euler(ca.DM(list(eta))).full()
    R = NED_ENU @ to_ned @ FRD_FLU
    from scipy.spatial.transform import Rotation

    x[ATTITUDE] = Rotation.from_matrix(R).as_quat(canonical=True, scalar_first=True)
    return x
