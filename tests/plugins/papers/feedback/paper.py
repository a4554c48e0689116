"""One sample of Lei & Li's control law, (27)-(40), in plain numpy and in the paper's frames: NED, FRD, '+' layout.

Nothing is imported from the program; the rotors are those of tests/paper.py.
"""

from math import pi, sqrt

import numpy as np

from tests.paper import RHO, TH, C, G, J, M, R, S, point
from tests.paper import D as ARM

E = np.eye(3)


def rotation(eta):
    (cp, ct, cs), (sp, st, ss) = np.cos(eta), np.sin(eta)
    return np.array(
        [
            [ct * cs, sp * st * cs - cp * ss, cp * st * cs + sp * ss],
            [ct * ss, sp * st * ss + cp * cs, cp * st * ss - sp * cs],
            [-st, sp * ct, cp * ct],
        ]
    )


def moments(T, Q):
    """(5)."""
    return np.array([ARM * (T[3] - T[1]), ARM * (T[0] - T[2]), -Q[0] + Q[1] - Q[2] + Q[3]])


def drag(v, coefficients):
    """(6)."""
    return 0.5 * RHO * S * np.linalg.norm(v) * coefficients["C_D"] * v


def motor(coefficients):
    """k_Tm, k_Qm."""
    return RHO * C * R**3 * TH * coefficients["C_la"] / 3, RHO * C * R**4 * coefficients["C_d0"] / 4


def static(coefficients):
    """k_T,static and k_Q,static."""
    k, q = motor(coefficients)
    c_la = coefficients["C_la"]
    nu = 0.5 * sqrt(C**2 * c_la**2 / (16 * pi**2) + 2 * C * R * TH * c_la / (3 * pi)) - C * c_la / (8 * pi)
    k_static = k - RHO * C * R**2 * c_la * nu / 2
    return k_static, q + k_static * nu


def secondary(v, w, coefficients):
    """H (2,), delta_T, delta_Gamma."""
    air = point(v, w, **coefficients)
    k, q = motor(coefficients)
    hub = v[:2] / np.hypot(v[0], v[1]) * air.H.sum()
    return hub, air.T.sum() - k * (w**2).sum(), moments(air.T, air.Q) - moments(k * w**2, q * w**2)


def observer_step(x, y, bandwidth, period, halvings=12):
    """(36) by the Taylor series of the exponential over a sliver of the period, doubled up."""
    gains = np.array([3 * bandwidth, 3 * bandwidth**2, bandwidth**3])
    A = np.zeros((3, 3))
    A[:, 0], A[0, 1], A[1, 2] = -gains, 1, 1
    big = np.zeros((4, 4))
    big[:3, :3], big[:3, 3] = A, gains
    small, power, total = big * period / 2**halvings, np.eye(4), np.eye(4)
    for n in range(1, 12):
        power = power @ small / n
        total = total + power
    for _ in range(halvings):
        total = total @ total
    return total[:3, :3] @ x + total[:3, 3] * y


def wrap(angle):
    return (angle + pi) % (2 * pi) - pi


def control(
    xi, velocity, eta, rate, xi_d, v_d, a_d, heading, last, coefficients, *, terms=(1, 1, 1, 1), coefficient_pair=None
):
    """One sample of (28)-(40), (27).

    heading: psi_d and its first and second derivative; the paper's own examples have psi_d' = psi_d'' = 0.

    last: eta_d, observer_phi, observer_theta, v (body), w of the sample before.
    terms: hub force, body drag, secondary thrust, secondary torque, each 0 or 1. coefficient_pair: of the allocation.
    Returns w^2 (4,), eta_d (3,), both observers, u_T.
    """
    psi_d, psi_d_dot, psi_d_ddot = heading
    v = rotation(eta).T @ velocity
    hub, delta_T, delta_Gamma = secondary(last["v"], last["w"], coefficients)
    D = drag(v, coefficients) * terms[1]
    H = hub * terms[0]
    R_last = rotation(last["eta_d"])
    u_xi = -(0.3 * (xi - xi_d) + 0.9 * (velocity - v_d))
    u_T = -R_last @ E[0] * (H[0] + D[0]) - R_last @ E[1] * (H[1] + D[1]) - M * (u_xi - G * E[2] + a_d)
    size = np.linalg.norm(u_T)
    T = size - delta_T * terms[2] - D[2]
    phi_d = np.arcsin((u_T[0] * np.sin(psi_d) - u_T[1] * np.cos(psi_d)) / size)
    theta_d = np.arctan((u_T[0] * np.cos(psi_d) + u_T[1] * np.sin(psi_d)) / u_T[2])
    x_phi = observer_step(last["observer_phi"], phi_d, 6.0, 0.01)
    x_theta = observer_step(last["observer_theta"], theta_d, 6.0, 0.01)
    sp, cp, st, ct = np.sin(eta[0]), np.cos(eta[0]), np.sin(eta[1]), np.cos(eta[1])
    W = np.array([[1, 0, -st], [0, cp, sp * ct], [0, -sp, cp * ct]])
    eta_dot = np.linalg.solve(W, rate)
    p, t = eta_dot[:2]
    W_dot = np.array(
        [[0, 0, -ct * t], [0, -sp * p, cp * ct * p - sp * st * t], [0, -cp * p, -sp * ct * p - cp * st * t]]
    )
    error = np.array([eta[0] - phi_d, eta[1] - theta_d, wrap(eta[2] - psi_d)])
    error_dot = eta_dot - np.array([x_phi[1], x_theta[1], psi_d_dot])
    wanted = -(0.8 * error + 2.4 * error_dot) + np.array([x_phi[2], x_theta[2], psi_d_ddot])
    Gamma = J @ (W @ wanted + W_dot @ eta_dot) + np.cross(rate, J @ rate) - delta_Gamma * terms[3]
    k, q = coefficient_pair or motor(coefficients)
    w2 = np.array(
        [
            T / (4 * k) + Gamma[1] / (2 * ARM * k) - Gamma[2] / (4 * q),
            T / (4 * k) - Gamma[0] / (2 * ARM * k) + Gamma[2] / (4 * q),
            T / (4 * k) - Gamma[1] / (2 * ARM * k) - Gamma[2] / (4 * q),
            T / (4 * k) + Gamma[0] / (2 * ARM * k) + Gamma[2] / (4 * q),
        ]
    )
    return w2, np.array([phi_d, theta_d, psi_d]), x_phi, x_theta, u_T
