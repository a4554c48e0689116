"""Rotor thrusts within their limits for a wanted thrust and torque, each clipped by itself."""

from __future__ import annotations

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression, limited
from quadexp.physics.vehicle import Vehicle


def clipped(vehicle: Vehicle, wrench: Expression) -> Expression:
    """Rotor thrusts G^+ (T, tau), (n,) (N), each clipped to its limits."""
    u = ca.DM(np.linalg.pinv(vehicle.allocation)) @ wrench
    return limited(u, vehicle.thrust_min, vehicle.thrust_max)


def saturated_count(vehicle: Vehicle, u: Expression) -> Expression:
    """How many of the thrusts (n,) (N) are at a limit."""
    return ca.sum1(u <= vehicle.thrust_min) + ca.sum1(u >= vehicle.thrust_max)
