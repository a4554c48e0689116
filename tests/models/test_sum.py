"""A residual with a scale: s times its outputs and derivatives, and at one the very residual."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.models.sum import scaled_residual
from tests.models.residuals import make_residual


@pytest.mark.parametrize("name", ["none", "linear_drag", "gp_with_mean"])
def test_it_scales_outputs_and_derivatives(vehicle, rng, name):
    residual = make_residual(name, vehicle)
    scaled, z = scaled_residual(residual), rng.normal(size=6 + vehicle.n_rotors)
    assert scaled.unscaled is residual and scaled.is_zero == residual.is_zero and scaled.name == residual.name
    values = [np.array(part) for part in residual.function(z, residual.theta)]
    for scale in (1.0, 0.0, 1.7):
        found = scaled.function(z, np.append(residual.theta, scale))
        for one, value in zip(found, values, strict=True):
            assert np.array(one) == pytest.approx(scale * value, abs=1e-14)
    assert scaled(z) == pytest.approx(residual(z), abs=0)
