"""A force, a thrust scale and an air scale at once, from the same accelerometer: a Kalman filter of random walks.

    y = R (f - T e_z / m - a_air) = a + k h + c g,     h = R (T e_z / m + da_air/du u),   g = R a_air

    a' = noise,  k' = noise,  c' = noise,   H = [I, h, g],   S = H P- H' + r I,   K = P- H' S^-1

a, the force over the mass, stands in the world; k, the error of the thrust scale (of the mass, of the thrust
coefficient), turns with the body; c, the error of the air's scale (drag, mass), turns with the velocity: h and
g tell them apart as soon as the vehicle turns or its thrust or speed changes. At constant h and g only their sum is
known, and it is shared by how much each is thought to change (P).

A force that sets in at once is no random walk, and is not to be learned as a scale: where the innovation nu is beyond
what is expected, nu' S^-1 nu > SURPRISE^2, the scales follow it that much less. P is that of the gain in use.

However fast the estimated force is, the filter believes in one of APART at most: a faster one takes the noise of the
readings for forces, the controller answers them with thrust, and what it answered with is taken for a scale. What the
filter leaves of y goes through a low pass of the whole bandwidth, e^ += gain (y - H [a, k, c] - e^); a^ + e^ is told.
"""

from __future__ import annotations

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression

N_SCALED = 5  # a, k, c
N_SCALED_STATE = N_SCALED + N_SCALED**2 + 3  # [a, k, c], P, e^
APART = 25.0  # rad/s
SCALES = (-0.5, 1.0)  # limits of k
AIR_SCALES = (-1.0, 4.0)  # of c
SURPRISE = 4.0


def scaled_force_update(
    s: Expression, y: Expression, h: Expression, g: Expression, walks: Expression, noise: Expression, gain: Expression
) -> tuple[Expression, Expression, Expression]:
    """[a (m/s^2), k, c], (5,), P, (25,), and e^, (3,).

    s: the three of the last step. y, h, g: (3,), world (m/s^2). walks: variances that a, k and c gain in a step, (3,).
    noise: variance r of a reading. gain: of the low pass.
    """
    found, P, fast = ca.vertsplit(s, [0, N_SCALED, N_SCALED + N_SCALED**2, N_SCALED_STATE])
    P = ca.reshape(P, N_SCALED, N_SCALED)
    P = P + ca.diag(ca.vertcat(walks[0], walks[0], walks))
    H = ca.horzcat(ca.DM.eye(3), h, g)
    S = ca.mtimes([H, P, H.T]) + noise * ca.DM.eye(3)
    inverted, error = inverse(S), y - ca.mtimes(H, found)
    surprise = ca.mtimes([error.T, inverted, error])
    trust = ca.fmin(1, SURPRISE / ca.sqrt(surprise + 1e-12))
    K = ca.mtimes([ca.diag(ca.vertcat(1, 1, 1, trust, trust)), P, H.T, inverted])
    found = found + ca.mtimes(K, error)
    left = ca.DM.eye(N_SCALED) - ca.mtimes(K, H)
    P = ca.mtimes([left, P, left.T]) + noise * ca.mtimes(K, K.T)  # Joseph's form
    scales = [ca.fmin(ca.fmax(found[3 + i], low), high) for i, (low, high) in enumerate((SCALES, AIR_SCALES))]
    fast = fast + gain * (y - ca.mtimes(H, found) - fast)
    return ca.vertcat(found[:3], *scales), ca.vec(P), fast


def inverse(S: ca.MX) -> ca.MX:
    """Of a 3 by 3 matrix, by cofactors."""
    rows = [S[i, :].T for i in range(3)]
    cofactors = ca.horzcat(*(ca.cross(rows[(i + 1) % 3], rows[(i + 2) % 3]) for i in range(3)))
    return cofactors / ca.dot(rows[0], cofactors[:, 0])
