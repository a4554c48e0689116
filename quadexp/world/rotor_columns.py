"""What of the rotors a flight has as columns: their speeds, or their thrusts where no speed is known.

A rotor turns at the speed of the thrust that its motor gives it, w = sqrt(T / k): lag, voltage and loss are seen there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle


def rotor_column_names(vehicle: Vehicle, first: int) -> Mapping[str, int]:
    """Columns of n inner states from `first` on."""
    name = "delivered" if vehicle.thrust_coefficient is None else "rotor_speed"
    return {f"{name}_{i}": first + i for i in range(vehicle.n_rotors)}


def rotor_column_factor(vehicle: Vehicle) -> float:
    """The parameter that `rotor_column` needs: thrust coefficient (N s^2), 0 where it is not known."""
    return vehicle.thrust_coefficient or 0.0


def rotor_column(thrust: Expression, factor: Expression) -> Expression:
    """Rotor speeds (n,) (rad/s) of thrusts (n,) (N); the thrusts where the factor is 0."""
    speed = ca.sqrt(ca.fmax(thrust, 0) / ca.fmax(factor, 1e-300))
    return ca.if_else(factor > 0, speed, thrust)


def first_rotor_column(vehicle: Vehicle, thrust: np.ndarray) -> Any:
    """The columns at thrusts (n,) (N); (n,)."""
    k = vehicle.thrust_coefficient
    return thrust if k is None else np.sqrt(thrust / k)
