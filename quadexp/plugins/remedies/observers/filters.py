"""What observers share: a torque from the body rates, and a force with the scales of thrust and air.

The torque that the model does not know, from measured body rates, which are never differentiated.

    w^-  = w^ + T [J^-1 (tau + tau_air - w x J w) + a^]        a^ = J^-1 tau^,   T: control period
    w^   = w^- + (1 - z^2) (w - w^-),     a^ += (1 - z)^2 / T (w - w^-),     z = exp(-b T)

tau: of the mean thrusts over the period. Both poles of the error are at z, for a bandwidth of b rad/s: from a torque to
its estimate, a^/a = ((1 - z)^2 / (q - z)^2) q, which is 1 at q = 1.

A force, a thrust scale and an air scale at once, from the same accelerometer: a Kalman filter of random walks.

    y = R (f - T e_z / m - a_air) = a + k h + c g,     h = R (T e_z / m + da_air/du u),   g = R a_air

    a' = noise,  k' = noise,  c' = noise,   H = [I, h, g],   S = H P- H' + r I,   K = P- H' S^-1

a, the force over the mass, stands in the world; k, the error of the thrust scale (of the mass, of the thrust
coefficient), turns with the body; c, the error of the air's scale (drag, mass), turns with the velocity: h and
g tell them apart as soon as the vehicle turns or its thrust or speed changes. At constant h and g only their sum is
known, and it is shared by how much each is thought to change (P).

A force that sets in at once is no random walk, and is not to be learned as a scale: where the innovation nu is beyond
what is expected, nu' S^-1 nu > SURPRISE^2, the scales follow it that much less. P is that of the gain in use.

However fast the estimated force is, the filter assumes one of APART at most: a faster one takes the noise of the
readings for forces, the controller answers them with thrust, and what it answered with is taken for a scale. What the
filter leaves of y goes through a low pass of the whole bandwidth, e^ += gain (y - H [a, k, c] - e^); a^ + e^ is given.
"""

from __future__ import annotations

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression, limited
from quadexp.physics.vehicle import Vehicle

N_TORQUE_STATE = 6  # w^, a^
N_TORQUE_SETTINGS = 3  # numbers of `settings`


def torque_settings(bandwidth: float, limit: float, period: float) -> list[float]:
    """Gains on w^ and on a^, and the limit (rad/s^2), for a bandwidth (rad/s); 0: a^ remains zero."""
    z = float(np.exp(-bandwidth * period))
    return [1 - z * z, (1 - z) ** 2 / period, limit]


def torque_update(
    s: Expression,
    w: Expression,
    mean: Expression,
    air_torque: Expression,
    settings: Expression,
    vehicle: Vehicle,
    period: float,
) -> tuple[Expression, Expression]:
    """Next state (6,), and the torque (3,), body (N m).

    s: w^, a^ (6,). w: measured body rate (3,) (rad/s). mean: thrusts over the last period, (n,) (N). air_torque: of the
    model, (3,) (N m). settings: of torque_settings.
    """
    inertia = ca.DM(vehicle.inertia_matrix)
    known = vehicle.allocation[1:] @ mean + air_torque - ca.cross(w, inertia @ w)
    predicted = s[:3] + period * (ca.inv(inertia) @ known + s[3:])
    error = w - predicted
    limit = settings[2]
    spin = limited(s[3:] + settings[1] * error, -limit, limit)
    return ca.vertcat(predicted + settings[0] * error, spin), inertia @ spin


N_SCALED = 5  # a, k, c
N_SCALED_STATE = N_SCALED + N_SCALED**2 + 3  # [a, k, c], P, e^
APART = 25.0  # rad/s
SCALES = (-0.5, 1.0)  # limits of k
AIR_SCALES = (-1.0, 4.0)  # of c
STATED = 0.3  # scale above which `auto` no longer makes good the stated noise of the thrust
SURPRISE = 4.0  # deviations: 1 in 16,000 of normal innovations of one axis


def scaled_force_update(
    s: Expression,
    y: Expression,
    h: Expression,
    g: Expression,
    walks: Expression,
    noise: Expression,
    gain: Expression,
    read: Expression = 1,
) -> tuple[Expression, Expression, Expression]:
    """[a (m/s^2), k, c], (5,), P, (25,), and e^, (3,).

    s: the three of the last step. y, h, g: (3,), world (m/s^2). walks: variances that a, k and c gain in a step, (3,).
    noise: variance r of a reading. gain: of the low pass.
    read: whether there is a reading; 0: a prediction alone.
    """
    estimate, P, fast = ca.vertsplit(s, [0, N_SCALED, N_SCALED + N_SCALED**2, N_SCALED_STATE])
    P = ca.reshape(P, N_SCALED, N_SCALED)
    P = P + ca.diag(ca.vertcat(walks[0], walks[0], walks))
    H = ca.horzcat(ca.DM.eye(3), h, g)
    S = H @ P @ H.T + noise * ca.DM.eye(3)
    inverted = inverse(S)
    error = y - H @ estimate
    surprise = error.T @ inverted @ error
    trust = ca.fmin(1, SURPRISE / ca.sqrt(surprise + 1e-12))
    K = read * (ca.diag(ca.vertcat(1, 1, 1, trust, trust)) @ P @ H.T @ inverted)
    estimate = estimate + K @ error
    reduction = ca.DM.eye(N_SCALED) - K @ H
    P = reduction @ P @ reduction.T + noise * (K @ K.T)  # Joseph's form
    scales = []
    for i, (low, high) in enumerate((SCALES, AIR_SCALES)):
        scales.append(limited(estimate[3 + i], low, high))
    fast = fast + read * gain * (y - H @ estimate - fast)
    return ca.vertcat(estimate[:3], *scales), ca.vec(P), fast


def inverse(S: ca.MX) -> ca.MX:
    """Of a 3 by 3 matrix, by cofactors."""
    rows = [S[i, :].T for i in range(3)]
    cofactors = ca.horzcat(*(ca.cross(rows[(i + 1) % 3], rows[(i + 2) % 3]) for i in range(3)))
    return cofactors / ca.dot(rows[0], cofactors[:, 0])
