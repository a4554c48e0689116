"""The zero residual: the nominal rigid body."""

from __future__ import annotations

from quadexp.air.base import N_OUTPUTS, Residual, feature_names, symbolic_residual
from quadexp.compile.symbolic import ca
from quadexp.physics.vehicle import Vehicle


def no_residual(vehicle: Vehicle) -> Residual:
    """y = 0, structurally."""
    features = ca.SX.sym("z", len(feature_names(vehicle.n_rotors)))
    return symbolic_residual("none", ca.SX(N_OUTPUTS, 1), features, ca.SX.sym("theta", 0), [])
