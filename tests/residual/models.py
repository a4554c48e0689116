"""One instance of every residual, for the contract and for everything that must work with any of them."""

from __future__ import annotations

import numpy as np

from quadexp.plant import PlantEffects, SimplifiedPlant
from quadexp.residual.base import Residual
from quadexp.residual.gaussian_process import GPOutput, gaussian_process_residual
from quadexp.residual.linear_drag import linear_drag_residual
from quadexp.residual.none import no_residual
from quadexp.vehicle import Vehicle

RESIDUALS = ("none", "linear_drag", "gp_per_axis", "gp_thrust", "gp_with_mean", "plant")


def make_residual(name: str, vehicle: Vehicle) -> Residual:
    """A residual with numbers of the size that fits give."""
    if name == "none":
        return no_residual(vehicle)
    if name == "linear_drag":
        return linear_drag_residual(vehicle, (0.5, 0.6, 0.1), (0.02, -0.01, 0.1), -0.015)
    if name == "plant":
        return SimplifiedPlant(vehicle, PlantEffects(payload=0.2), backend="interpreted").residual()
    rng = np.random.default_rng(5)
    features = {"a_x": ("v_x",), "a_y": ("v_y",), "a_z": ("v_z",)}
    if name == "gp_thrust":
        features = {"a_x": ("v_x", "w_y"), "a_z": ("v_z", "thrust"), "tau_y": ("v_x", "u_1", "w_y")}
    outputs = [
        GPOutput(
            output, names, rng.uniform(-10, 10, (15, len(names))), rng.normal(size=15), rng.uniform(3, 8, len(names))
        )
        for output, names in features.items()
    ]
    mean = (0.4, 0.3, 0.1, 0.0, 0.01, 0.1, -0.02) if name == "gp_with_mean" else None
    return gaussian_process_residual(vehicle, outputs, mean)
