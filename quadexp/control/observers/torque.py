"""The torque that the model does not know, from measured body rates, which are never differentiated.

    w^-  = w^ + T [J^-1 (tau + tau_air - w x J w) + a^]        a^ = J^-1 tau^,   T: control period
    w^   = w^- + (1 - z^2) (w - w^-),     a^ += (1 - z)^2 / T (w - w^-),     z = exp(-b T)

tau: of the mean thrusts over the period. Both poles of the error are at z, for a bandwidth of b rad/s: from a torque to
its estimate, a^/a = ((1 - z)^2 / (q - z)^2) q, which is 1 at q = 1.
"""

from __future__ import annotations

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle

N_TORQUE_STATE = 6  # w^, a^
N_TORQUE_SETTINGS = 3


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
    known = ca.mtimes(ca.DM(vehicle.allocation[1:]), mean) + air_torque - ca.cross(w, ca.mtimes(inertia, w))
    predicted = s[:3] + period * (ca.mtimes(ca.inv(inertia), known) + s[3:])
    error, limit = w - predicted, settings[2]
    spin = ca.fmin(ca.fmax(s[3:] + settings[1] * error, -limit), limit)
    return ca.vertcat(predicted + settings[0] * error, spin), ca.mtimes(inertia, spin)
