"""A force and a thrust scale at once, from the same accelerometer: a Kalman filter of two random walks.

    y = R (f - T e_z / m - a_air) = a + k h,     h = R (T e_z / m + da_air/du u)          f: accelerometer

    a' = noise,   k' = noise,   H = [I, h],   S = H P- H' + r I,   K = P- H' S^-1

a, the force over the mass, stands in the world; k, the error of the thrust scale (of the mass, of the thrust
coefficient), turns with the body: h tells them apart as soon as the vehicle turns or its thrust changes. At a constant
h only their sum is known, and it is shared by how much each is thought to change (P).
"""

from __future__ import annotations

import casadi as ca

from quadexp.physics.expression import Expression

N_SCALED = 4  # a, k
N_SCALED_STATE = N_SCALED + N_SCALED**2
SCALES = (-0.5, 1.0)  # limits of k


def scaled_force_update(
    s: Expression, y: Expression, h: Expression, walk: Expression, scale_walk: Expression, noise: Expression
) -> tuple[Expression, Expression]:
    """a (3,) (m/s^2) with k, (4,), and P, (16,).

    s: [a, k, P] of the last step. y, h: (3,), world (m/s^2). walk, scale_walk: variances that a and k gain in a step.
    noise: variance r of a reading.
    """
    found, P = s[:N_SCALED], ca.reshape(s[N_SCALED:], N_SCALED, N_SCALED)
    P = P + ca.diag(ca.vertcat(walk, walk, walk, scale_walk))
    H = ca.horzcat(ca.DM.eye(3), h)
    S = ca.mtimes([H, P, H.T]) + noise * ca.DM.eye(3)
    K = ca.mtimes([P, H.T, inverse(S)])
    found = found + ca.mtimes(K, y - ca.mtimes(H, found))
    left = ca.DM.eye(N_SCALED) - ca.mtimes(K, H)
    P = ca.mtimes([left, P, left.T]) + noise * ca.mtimes(K, K.T)  # Joseph's form
    return ca.vertcat(found[:3], ca.fmin(ca.fmax(found[3], SCALES[0]), SCALES[1])), ca.vec(P)


def inverse(S: ca.MX) -> ca.MX:
    """Of a 3 by 3 matrix, by cofactors."""
    rows = [S[i, :].T for i in range(3)]
    cofactors = ca.horzcat(*(ca.cross(rows[(i + 1) % 3], rows[(i + 2) % 3]) for i in range(3)))
    return cofactors / ca.dot(rows[0], cofactors[:, 0])
