"""The form of a Gaussian process or a network that gets compiled: the numbers of the interpreted one."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.compile.backend import realise
from tests.models.residuals import make_residual

FORMS = ["gp_per_axis", "gp_thrust", "gp_with_mean", "neural", "sum"]


@pytest.mark.parametrize("name", FORMS)
def test_it_takes_and_gives_the_same(vehicle, name):
    """Shapes and structural zeros, with or without a compiler."""
    residual = make_residual(name, vehicle)
    for side in ("sparsity_in", "sparsity_out"):
        for i in range(2):
            assert getattr(residual.to_compile, side)(i) == getattr(residual.function, side)(i)


@pytest.mark.parametrize("name", FORMS)
def test_hand_written_sums_are_the_matrix_ones(vehicle, name, rng):
    residual = make_residual(name, vehicle)
    compiled = realise(residual.to_compile, "compiled")
    for size in (1.0, 8.0, 80.0):  # the last one is out of every point's reach
        z = size * rng.normal(size=6 + vehicle.n_rotors)
        for there, here in zip(compiled(z, residual.theta), residual.function(z, residual.theta), strict=True):
            assert there.sparsity() == here.sparsity()
            assert np.allclose(there.nonzeros(), here.nonzeros(), rtol=1e-12, atol=1e-13)
