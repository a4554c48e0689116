"""A checkpoint without a fit."""

import numpy as np

from quadexp.experiment.build import build_vehicle
from quadexp.models.checkpoint import save_model
from quadexp.models.linear_drag import LinearDrag
from quadexp.parts.compose import compose


def make_checkpoint(folder, drag=0.3):
    """A linear-drag checkpoint with numbers by hand."""
    vehicle = build_vehicle(compose([]).vehicle)
    numbers = {"drag": np.array([drag, drag, 0.1]), "intercept": np.zeros(3), "thrust_gain": 0.0}
    errors = {"drag_error": np.zeros(3), "intercept_error": np.zeros(3), "thrust_gain_error": 0.0}
    fit = {"residual_std": np.zeros(3), "r_squared": np.ones(3), "n": 10}
    named = {"name": vehicle.name, "fingerprint": vehicle.fingerprint}
    save_model(folder, LinearDrag(**numbers, **errors, **fit, vehicle=named), force=True)
