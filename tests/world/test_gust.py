"""The one-minus-cosine gust: shape, integral."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import quad

from quadexp.world.gust import one_minus_cosine

AMPLITUDE = ca.DM([3.0, -2.0, 0.5])


@pytest.mark.parametrize(("start", "duration"), [(0.0, 2.0), (1.3, 0.4), (5.0, 11.0)])
def test_the_integral_is_half_the_amplitude_times_the_duration(start, duration):
    for axis in range(3):
        found, _ = quad(
            lambda t, axis=axis: float(one_minus_cosine(t, start, duration, AMPLITUDE)[axis]), 0, 20, limit=200,
            points=(start, start + duration),
        )  # fmt: skip
        assert found == pytest.approx(float(AMPLITUDE[axis]) * duration / 2, rel=1e-9)


def test_it_begins_and_ends_smoothly_and_peaks_in_the_middle():
    t = ca.SX.sym("t")
    gust = ca.Function("gust", [t], [one_minus_cosine(t, 1.0, 2.0, AMPLITUDE)])
    assert gust(2.0).full().ravel() == pytest.approx(AMPLITUDE.full().ravel(), rel=1e-14)
    assert gust(1.5).full().ravel() == pytest.approx(AMPLITUDE.full().ravel() / 2, rel=1e-12)
    for when in (-3.0, 0.999, 1.0, 3.0, 3.001, 50.0):
        assert np.abs(gust(when).full()).max() < 1e-12
    for edge in (1.0, 3.0):
        slope = (gust(edge + 1e-4) - gust(edge - 1e-4)) / 2e-4
        assert np.abs(slope.full()).max() < 1e-2
