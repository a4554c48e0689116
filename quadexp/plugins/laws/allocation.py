"""Rotor thrusts within their limits for a wanted thrust and torque: the nearest wrench, or by priority.

Nearest, exactly (`exact_allocation`; (31) of Sun et al. 2022, there with a quadratic program solver):

    u = argmin_{l <= u <= h} |y - G u|_W^2 (+ e |u|^2 for more than four rotors, which makes it unique)

Every rotor is at its lower limit, at its upper limit or free: 3^n faces. On each the minimum is affine in y,
u = A_f y + b_f, known beforehand. The problem is convex, so that the best of those within the limits is the minimum.

By priority (`prioritised`): tilt, then thrust, then yaw. With the columns of G^+ = [c_T, c_x, c_y, c_z], all c_T > 0,
and bounds l, h of a rotor's thrust:

    u = T c_T + s (c_x tau_x + c_y tau_y) + r c_z tau_z                                                             (1)

    s    the largest in [0, 1] for which some T keeps all rotors within l .. h without the last term: for all i, j
         s (t_j / c_T,j - t_i / c_T,i) <= h / c_T,j - l / c_T,i,     t = c_x tau_x + c_y tau_y                       (2)
    T    nearest to the wanted one that does so
    r    the largest in [0, 1] that does so with it

A plain clip of G^+ (T, tau) instead changes all four at once: near full thrust a yaw torque that is too large tilts the
vehicle. Flight stacks do the same ("airmode" for roll and pitch). World ENU, body FLU, SI.
"""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.allocation import clipped
from quadexp.errors import UsageError
from quadexp.physics.expression import Expression, limited
from quadexp.physics.vehicle import Vehicle

MOST_ROTORS = 6  # 729 faces
REGULAR = 1e-7  # e, relative to the largest entry of G'WG
TOLERANCE = 1e-9  # of the thrust range within which a thrust is within its limits
NEVER = 1e30  # cost of a face whose minimum is outside the limits; a number in single precision too


def faces(vehicle: Vehicle, weight: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """A_f (f, n, 4) and b_f (f, n) of every face; weight: diagonal of W, (4,).

    Raises UsageError for more rotors than MOST_ROTORS.
    """
    n = vehicle.n_rotors
    if n > MOST_ROTORS:
        raise UsageError(
            f"vehicle={vehicle.name}: has {n} rotors; the exact allocation goes over 3^n faces, for up to"
            f" {MOST_ROTORS} rotors: use allocation=clip"
        )
    G = vehicle.allocation
    weighted = G.T @ np.diag(weight)
    H = weighted @ G
    if n > len(G):
        H += REGULAR * H.max() * np.eye(n)
    sides = (np.nan, vehicle.thrust_min, vehicle.thrust_max)  # of a free rotor, and of one at a limit
    b = np.array(list(itertools.product(sides, repeat=n)))
    A = np.zeros((*b.shape, 4))
    for gain, offset in zip(A, b, strict=True):
        free = np.isnan(offset)
        offset[free] = 0
        if free.any():
            inner = H[np.ix_(free, free)]
            at_limits = H[np.ix_(free, ~free)] @ offset[~free]
            gain[free] = np.linalg.solve(inner, weighted[free])
            offset[free] = -np.linalg.solve(inner, at_limits)
    return A, b


@lru_cache(maxsize=16)
def exact_allocation(vehicle: Vehicle, weight: tuple[float, ...]) -> ca.Function:
    """wanted [T (N), tau (N m)] (4,) -> thrusts u (n,) (N). weight, errors: see `faces`."""
    A, b = faces(vehicle, weight)
    low = vehicle.thrust_min
    high = vehicle.thrust_max
    y = ca.MX.sym("wrench", 4)
    thrusts = ca.DM(A.reshape(-1, 4)) @ y + ca.DM(b.ravel())
    U = ca.reshape(thrusts, vehicle.n_rotors, len(A))
    below = ca.fmax(low - U, 0)
    above = ca.fmax(U - high, 0)
    beyond = ca.sum1(below + above)
    short = ca.repmat(y, 1, len(A)) - vehicle.allocation @ U
    weights = ca.repmat(ca.DM(weight), 1, len(A))
    cost = ca.sum1(weights * short**2)
    if vehicle.n_rotors > len(weight):
        H = vehicle.allocation.T @ np.diag(weight) @ vehicle.allocation
        cost += REGULAR * H.max() * ca.sum1(U**2)
    cost = ca.if_else(beyond > TOLERANCE * (high - low), NEVER, cost)
    chosen = cost <= ca.mmin(cost)
    u = U @ chosen.T / ca.sum2(chosen)  # faces of equal cost meet in one point
    return ca.Function("allocation", [y], [limited(u, low, high)], ["wrench"], ["thrust"])


def allocation(vehicle: Vehicle, kind: str, weight: tuple[float, ...]) -> ca.Function:
    """The allocation of a setting, "exact" or "clip": wanted [T (N), tau (N m)] (4,) -> thrusts u (n,) (N)."""
    if kind == "exact":
        return exact_allocation(vehicle, weight)
    y = ca.MX.sym("wrench", 4)
    return ca.Function("allocation", [y], [clipped(vehicle, y)], ["wrench"], ["thrust"])


TINY = 1e-12  # of a difference below which nothing limits a share


def prioritised(vehicle: Vehicle, wrench: Expression, *, airmode: bool = True, yaw_margin: float = 0.0) -> Expression:
    """Rotor thrusts, (n,) (N), within the vehicle's limits.

    wrench: wanted [T (N), tau (N m)], (4,), body. airmode: the thrust may be raised above the wanted one where tilt
    needs it. yaw_margin: share of the thrust range by which yaw may take thrust away at the upper limit (PX4: 0.15).
    Raises UsageError for a rotor layout in which equal lift needs a negative thrust.
    """
    n = vehicle.n_rotors
    low = vehicle.thrust_min
    high = vehicle.thrust_max
    inverse = np.linalg.pinv(vehicle.allocation)
    lift = inverse[:, 0]
    if (lift <= 0).any():
        raise UsageError(f"vehicle={vehicle.name}: thrust by priority needs rotors that all lift at once")
    tilt = ca.DM(inverse[:, 1:3]) @ wrench[1:3]
    yaw = ca.DM(inverse[:, 3]) * wrench[3]
    per_lift = tilt / lift
    share = ca.SX(1)
    for i in range(n):
        for j in range(n):
            if i != j:
                room = high / lift[j] - low / lift[i]
                share = ca.fmin(share, _share(per_lift[j] - per_lift[i], room))
    if not airmode:  # rotors at the lower limit already: less tilt, not more thrust
        wanted = ca.fmax(wrench[0], (low / lift).max())
        for i in range(n):
            share = ca.fmin(share, _share(-per_lift[i], wanted - low / lift[i]))
    tilt = share * tilt
    thrust = _within(wrench[0], (low - tilt) / lift, (high - tilt) / lift)
    u = thrust * lift + tilt
    share = ca.SX(1)
    allowed = high + yaw_margin * (high - low)
    for i in range(n):
        upwards = _share(yaw[i], allowed - u[i])
        downwards = _share(-yaw[i], u[i] - low)
        share = ca.fmin(share, ca.fmin(upwards, downwards))
    u = u + ca.fmax(share, 0) * yaw
    if yaw_margin:
        u += _within(0, (low - u) / lift, (high - u) / lift) * lift
    return limited(u, low, high)


def _share(step: Expression, room: Expression) -> Expression:
    """Largest share of `step` that is at most `room`; above 1 where nothing limits it."""
    return ca.if_else(step > TINY, room / ca.fmax(step, TINY), 2)


def _within(value: Expression, low: Expression, high: Expression) -> Expression:
    """`value` within the largest of `low` and the smallest of `high`."""
    return limited(value, ca.mmax(low), ca.mmin(high))
