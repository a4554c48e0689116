"""Rotor thrusts within their limits for a wanted thrust and torque, by priority: tilt, then thrust, then yaw.

With the columns of G^+ = [c_T, c_x, c_y, c_z], all c_T > 0, and bounds l, h of a rotor's thrust:

    u = T c_T + s (c_x tau_x + c_y tau_y) + r c_z tau_z                                                             (1)

    s    the largest in [0, 1] for which some T keeps all rotors within l .. h without the last term: for all i, j
         s (t_j / c_T,j - t_i / c_T,i) <= h / c_T,j - l / c_T,i,     t = c_x tau_x + c_y tau_y                       (2)
    T    nearest to the wanted one that does so
    r    the largest in [0, 1] that does so with it

A plain clip of G^+ (T, tau) instead changes all four at once: near full thrust a yaw torque that is too large tilts the
vehicle. Flight stacks do the same ("airmode" for roll and pitch). World ENU, body FLU, SI.
"""

from __future__ import annotations

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle

TINY = 1e-12  # of a difference below which nothing limits a share


def prioritised(vehicle: Vehicle, wrench: Expression, *, airmode: bool = True, yaw_margin: float = 0.0) -> Expression:
    """Rotor thrusts, (n,) (N), within the vehicle's limits.

    wrench: wanted [T (N), tau (N m)], (4,), body. airmode: the thrust may be raised above the wanted one where tilt
    needs it. yaw_margin: share of the thrust range by which yaw may take thrust away at the upper limit (PX4: 0.15).
    Raises UsageError for a rotor layout in which equal lift needs a negative thrust.
    """
    inverse, low, high = np.linalg.pinv(vehicle.allocation), vehicle.thrust_min, vehicle.thrust_max
    lift = inverse[:, 0]
    if (lift <= 0).any():
        raise UsageError(f"vehicle={vehicle.name}: thrust by priority needs rotors that all lift at once")
    tilt, yaw = ca.mtimes(ca.DM(inverse[:, 1:3]), wrench[1:3]), ca.DM(inverse[:, 3]) * wrench[3]
    n, per_lift = vehicle.n_rotors, tilt / lift
    share = ca.SX(1)
    for i in range(n):
        for j in range(n):
            if i != j:
                share = ca.fmin(share, _share(per_lift[j] - per_lift[i], high / lift[j] - low / lift[i]))
    if not airmode:  # rotors at the lower limit already: less tilt, not more thrust
        wanted = ca.fmax(wrench[0], (low / lift).max())
        for i in range(n):
            share = ca.fmin(share, _share(-per_lift[i], wanted - low / lift[i]))
    tilt = share * tilt
    thrust = _within(wrench[0], (low - tilt) / lift, (high - tilt) / lift)
    u = thrust * lift + tilt
    share, allowed = ca.SX(1), high + yaw_margin * (high - low)
    for i in range(n):
        share = ca.fmin(share, ca.fmin(_share(yaw[i], allowed - u[i]), _share(-yaw[i], u[i] - low)))
    u = u + ca.fmax(share, 0) * yaw
    u = u + _within(0, (low - u) / lift, (high - u) / lift) * lift if yaw_margin else u
    return ca.fmin(ca.fmax(u, low), high)


def clipped(vehicle: Vehicle, wrench: Expression) -> Expression:
    """Rotor thrusts G^+ (T, tau), (n,) (N), each clipped to its limits."""
    u = ca.mtimes(ca.DM(np.linalg.pinv(vehicle.allocation)), wrench)
    return ca.fmin(ca.fmax(u, vehicle.thrust_min), vehicle.thrust_max)


def held(vehicle: Vehicle, u: Expression) -> Expression:
    """How many of the thrusts (n,) (N) are at a limit."""
    return ca.sum1(u <= vehicle.thrust_min) + ca.sum1(u >= vehicle.thrust_max)


def _share(step: Expression, room: Expression) -> Expression:
    """Largest share of `step` that is at most `room`; above 1 where nothing limits it."""
    return ca.if_else(step > TINY, room / ca.fmax(step, TINY), 2)


def _within(value: Expression, low: Expression, high: Expression) -> Expression:
    """`value` within the largest of `low` and the smallest of `high`."""
    return ca.fmin(ca.fmax(value, ca.mmax(low)), ca.mmin(high))
