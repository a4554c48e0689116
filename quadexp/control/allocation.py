"""Rotor thrusts within their limits whose wrench is nearest to a wanted one, exactly.

    u = argmin_{l <= u <= h} |y - G u|_W^2 (+ e |u|^2 for more than four rotors, which makes it unique)

Every rotor is at its lower limit, at its upper limit or free: 3^n faces. On each the minimum is affine in y,
u = A_f y + b_f, known beforehand. The problem is convex, so that the best of those within the limits is the minimum.

Source: (31) of Sun et al. 2022, there with a quadratic program solver.
"""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.physics.vehicle import Vehicle

MOST_ROTORS = 6  # 729 faces
REGULAR = 1e-7  # e, relative to the largest entry of G'WG
TOLERANCE = 1e-9  # of the thrust range within which a thrust is within its limits
NEVER = 1e300  # cost of a face whose minimum is outside the limits


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
    G, W = vehicle.allocation, np.diag(weight)
    H = G.T @ W @ G
    if n > len(G):
        H += REGULAR * H.max() * np.eye(n)
    combinations = list(itertools.product((None, vehicle.thrust_min, vehicle.thrust_max), repeat=n))
    A, b = np.zeros((len(combinations), n, 4)), np.zeros((len(combinations), n))
    for gain, offset, sides in zip(A, b, combinations, strict=True):
        free = np.array([side is None for side in sides])
        offset[~free] = [side for side in sides if side is not None]
        if free.any():
            inner = H[np.ix_(free, free)]
            gain[free] = np.linalg.solve(inner, (G.T @ W)[free])
            offset[free] = -np.linalg.solve(inner, H[np.ix_(free, ~free)] @ offset[~free])
    return A, b


@lru_cache(maxsize=16)
def exact_allocation(vehicle: Vehicle, weight: tuple[float, ...]) -> ca.Function:
    """wanted [T (N), tau (N m)] (4,) -> thrusts u (n,) (N). weight, errors: see `faces`."""
    A, b = faces(vehicle, weight)
    n, low, high = vehicle.n_rotors, vehicle.thrust_min, vehicle.thrust_max
    y = ca.MX.sym("wrench", 4)
    U = ca.reshape(ca.mtimes(ca.DM(A.reshape(-1, 4)), y) + ca.DM(b.ravel()), n, len(A))
    beyond = ca.sum1(ca.fmax(low - U, 0) + ca.fmax(U - high, 0))
    short = ca.repmat(y, 1, len(A)) - ca.mtimes(ca.DM(vehicle.allocation), U)
    cost = ca.sum1(ca.repmat(ca.DM(weight), 1, len(A)) * short**2)
    if n > len(weight):
        H = vehicle.allocation.T @ np.diag(weight) @ vehicle.allocation
        cost += REGULAR * H.max() * ca.sum1(U**2)
    cost = ca.if_else(beyond > TOLERANCE * (high - low), NEVER, cost)
    chosen = cost <= ca.mmin(cost)
    u = ca.mtimes(U, chosen.T) / ca.sum2(chosen)  # faces of equal cost meet in one point
    return ca.Function("allocation", [y], [ca.fmin(ca.fmax(u, low), high)], ["wrench"], ["thrust"])


def clipped_allocation(vehicle: Vehicle) -> ca.Function:
    """wanted [T (N), tau (N m)] (4,) -> thrusts u = G^+ y (n,) (N), each clipped to its limits."""
    y = ca.MX.sym("wrench", 4)
    u = ca.mtimes(ca.DM(np.linalg.pinv(vehicle.allocation)), y)
    u = ca.fmin(ca.fmax(u, vehicle.thrust_min), vehicle.thrust_max)
    return ca.Function("allocation", [y], [u], ["wrench"], ["thrust"])


def allocation(vehicle: Vehicle, kind: str, weight: tuple[float, ...]) -> ca.Function:
    """The allocation of a setting, "exact" or "clip"."""
    return exact_allocation(vehicle, weight) if kind == "exact" else clipped_allocation(vehicle)
