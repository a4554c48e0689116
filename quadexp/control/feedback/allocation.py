"""Control allocation, Lei & Li 2017, equation (27): rotor speeds squared that give a thrust and three torques.

    (T, Gamma) = Pi (w_1^2 .. w_n^2),    Pi = [k; -k y; k x; q s]     per rotor at (x, y), FRD

k: thrust, q: drag torque per speed squared, s: sign of the reaction torque about the body's z axis (down). In the
paper's '+' layout, arm d, the inverse is

    w_1^2 = T/4k + Gamma_y/2dk - Gamma_z/4q,   w_2^2 = T/4k - Gamma_x/2dk + Gamma_z/4q,   ...

so k and q are divisors: with q near zero a small yaw torque demands an arbitrarily large speed. Estimates are therefore
clipped (quadexp.models.rls) to at least half of their initial values.
"""

from __future__ import annotations

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.feedback.frames import FRD_FLU
from quadexp.errors import UsageError
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle


def unit_allocation(vehicle: Vehicle) -> np.ndarray:
    """Pi for k = q = 1, (4, 4), FRD.

    Raises UsageError for a vehicle without four rotors.
    """
    if vehicle.n_rotors != 4:
        raise UsageError(
            f"vehicle={vehicle.name}: feedback control needs 4 rotors, this vehicle has {vehicle.n_rotors}"
        )
    x, y, _ = FRD_FLU @ np.array(vehicle.rotor_position, float).T
    return np.stack([np.ones(4), -y, x, -np.array(vehicle.rotor_spin, float)])


def allocate(
    thrust: Expression,
    torque: Expression,
    thrust_coefficient: Expression,
    torque_coefficient: Expression,
    inverse: np.ndarray,
) -> Expression:
    """Squared rotor speeds, (4,) (rad^2/s^2): equation (27) solved.

    thrust: T (N). torque: Gamma (3,), FRD (N m). thrust_coefficient: k (N s^2). torque_coefficient: q (N m s^2).
    inverse: of `unit_allocation`, (4, 4).
    """
    scaled = ca.vertcat(ca.vertcat(thrust, torque[0], torque[1]) / thrust_coefficient, torque[2] / torque_coefficient)
    return ca.mtimes(inverse, scaled)
