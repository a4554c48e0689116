"""Attitude control, Lei & Li 2017, equations (37)-(40): from desired Euler angles to torque.

Body FRD, eta = (phi, theta, psi):

    (37)  Omega = W eta_dot,    W = [1 0 -sin theta; 0 cos phi sin phi cos theta; 0 -sin phi cos phi cos theta]
    (39)  u_eta = -(K_p e_eta + K_d e_eta_dot)                     the yaw error wrapped to (-pi, pi]
    (40)  Gamma_m = J (W (u_eta + eta_d_ddot) + W_dot W^-1 Omega) + Omega x J Omega - delta_Gamma

The minus sign of (39) is missing in print; without it the loop is unstable. W is singular at theta = +-90 deg.
"""

from __future__ import annotations

import math

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression

COSINE_MIN = 1e-6  # lower bound on |cos theta| in W^-1, which is singular at 90 deg


def rate_matrix(eta: Expression) -> Expression:
    """W, (3, 3): equation (37). eta (3,) (rad)."""
    sp, cp, st, ct = ca.sin(eta[0]), ca.cos(eta[0]), ca.sin(eta[1]), ca.cos(eta[1])
    return ca.vertcat(ca.horzcat(1, 0, -st), ca.horzcat(0, cp, sp * ct), ca.horzcat(0, -sp, cp * ct))


def euler_rates(eta: Expression, rate: Expression) -> Expression:
    """eta_dot = W^-1 Omega, (3,) (rad/s). rate: Omega (3,), FRD (rad/s)."""
    sp, cp, ct = ca.sin(eta[0]), ca.cos(eta[0]), ca.cos(eta[1])
    ct = ca.if_else(ct < 0, -1, 1) * ca.fmax(ca.fabs(ct), COSINE_MIN)
    heading = (sp * rate[1] + cp * rate[2]) / ct
    return ca.vertcat(rate[0] + ca.sin(eta[1]) * heading, cp * rate[1] - sp * rate[2], heading)


def wrapped(angle: Expression) -> Expression:
    """The angle (rad) in (-pi, pi]."""
    return angle - 2 * math.pi * ca.ceil((angle - math.pi) / (2 * math.pi))


def attitude_error(eta: Expression, eta_d: Expression) -> Expression:
    """e_eta = eta - eta_d, (3,) (rad), the yaw error wrapped."""
    return ca.vertcat(eta[0] - eta_d[0], eta[1] - eta_d[1], wrapped(eta[2] - eta_d[2]))


def attitude_torque(
    eta: Expression,
    rate: Expression,
    error: Expression,
    eta_d_dot: Expression,
    eta_d_ddot: Expression,
    proportional: Expression,
    derivative: Expression,
    inertia: Expression,
    compensation: Expression,
) -> Expression:
    """Gamma_m, (3,), FRD (N m): equations (39), (40).

    eta, error: (3,) (rad). rate: Omega (3,) (rad/s). eta_d_dot, eta_d_ddot: (3,) (rad/s, rad/s^2).
    proportional, derivative: gains (3,) (1/s^2, 1/s). inertia: J (3, 3), FRD (kg m^2).
    compensation: delta_Gamma (3,) (N m).
    """
    eta_dot = euler_rates(eta, rate)
    u_eta = -(proportional * error + derivative * (eta_dot - eta_d_dot))
    W_dot = _rate_matrix_derivative()(eta, eta_dot)
    acceleration = ca.mtimes(rate_matrix(eta), u_eta + eta_d_ddot) + ca.mtimes(W_dot, eta_dot)
    return ca.mtimes(inertia, acceleration) + ca.cross(rate, ca.mtimes(inertia, rate)) - compensation


def _rate_matrix_derivative() -> ca.Function:
    """(eta, eta_dot) -> W_dot, (3, 3)."""
    eta, eta_dot = ca.SX.sym("eta", 3), ca.SX.sym("eta_dot", 3)
    derivative = ca.jtimes(ca.vec(rate_matrix(eta)), eta, eta_dot)
    return ca.Function("W_dot", [eta, eta_dot], [ca.reshape(derivative, 3, 3)])
