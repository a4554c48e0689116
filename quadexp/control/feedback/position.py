"""Position control, Lei & Li 2017, equations (28)-(35): from the tracking error to collective thrust and tilt.

World NED, body FRD. With H the hub force, D the body drag and delta_T the thrust deviation (compensation.py):

    (30)  u_xi = -(K_p e_xi + K_d e_v)                                             e_xi = xi - xi_d
    (32)  u_T  = -R_d,k-1 (H_x + D_x) e1 - R_d,k-1 (H_y + D_y) e2 - m (u_xi - g e3 + a_d)
    (33)  T_m  = ||u_T|| - delta_T - D_z
    (34)  phi_d   = arcsin((u_Tx sin psi_d - u_Ty cos psi_d) / ||u_T||)
    (35)  theta_d = arctan((u_Tx cos psi_d + u_Ty sin psi_d) / u_Tz)

(35) gives the wrong quadrant for a downward thrust, u_Tz < 0; `in_cone` excludes it.
"""

from __future__ import annotations

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression


def position_feedback(
    error: Expression, velocity_error: Expression, proportional: Expression, derivative: Expression
) -> Expression:
    """u_xi, (3,), NED (m/s^2): equation (30). Errors (3,) (m, m/s); gains (3,) (1/s^2, 1/s)."""
    return -(proportional * error + derivative * velocity_error)


def thrust_vector(
    u_xi: Expression, acceleration: Expression, R_last: Expression, lateral: Expression, mass: float, gravity: float
) -> Expression:
    """u_T, (3,), NED (N): equation (32). It points along the body's z axis (down), opposite to the thrust.

    acceleration: a_d (3,), NED (m/s^2). R_last: R_d,k-1, (3, 3). lateral: (H + D)_xy, (2,), FRD (N).
    """
    lateral_force = ca.mtimes(R_last, ca.vertcat(lateral, 0))
    return -lateral_force - mass * (u_xi - ca.vertcat(0, 0, gravity) + acceleration)


def in_cone(u_T: Expression, down_min: float, tilt_max: float) -> tuple[Expression, Expression]:
    """u_T limited to a cone about the vertical, (3,) (N), and whether it was outside (0 or 1).

    down_min: least u_Tz (N). tilt_max: largest angle from the vertical (rad); the vertical component is kept.
    """
    down = ca.fmax(u_T[2], down_min)
    across = ca.sqrt(u_T[0] ** 2 + u_T[1] ** 2)
    allowed = ca.tan(tilt_max) * down
    share = ca.if_else(across > allowed, allowed / ca.fmax(across, 1e-12), 1.0)
    outside = ca.logic_or(u_T[2] < down_min, across > allowed)
    return ca.vertcat(share * u_T[0], share * u_T[1], down), outside


def desired_tilt(u_T: Expression, psi: Expression) -> tuple[Expression, Expression]:
    """phi_d, theta_d (rad): equations (34), (35). u_T (3,) NED (N), psi: desired heading (rad)."""
    sine, cosine = ca.sin(psi), ca.cos(psi)
    roll = ca.asin(ca.fmin(ca.fmax((u_T[0] * sine - u_T[1] * cosine) / ca.norm_2(u_T), -1.0), 1.0))
    return roll, ca.atan((u_T[0] * cosine + u_T[1] * sine) / u_T[2])
