"""The blade-element residual: zero where the static map is right, linear drag at low speed, regular at the edges."""

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.plugins.aerodynamics.coefficients import BladeCoefficients
from quadexp.plugins.papers.lei_li.blade_element import blade_element_residual
from tests import paper


@pytest.fixture(scope="module")
def residual(lei_li, blade):
    return blade_element_residual(lei_li, blade, "Table 1")


def features(v, u) -> np.ndarray:
    return np.r_[v, np.zeros(3), u]


def test_zero_in_still_air(residual, rng):
    """At V = 0 the static thrust map and the reaction torque are exact, for any four thrusts above idling."""
    for _ in range(20):
        y = residual(features(np.zeros(3), rng.uniform(0.05, 15, 4)))[0]
        assert y == pytest.approx(np.zeros(6), abs=1e-13)


def test_is_the_paper_less_the_static_map(lei_li, residual, rng):
    for _ in range(20):
        v, u = rng.normal(0, 5, 3) * [1, 1, 0.5], rng.uniform(1, 6, 4)
        point = paper.point(paper.flip(v), np.sqrt(u / lei_li.thrust_coefficient))
        y = residual(features(v, u))[0]
        assert y[:3] == pytest.approx(paper.flip(point.F) / paper.M - [0, 0, u.sum() / paper.M], rel=1e-7, abs=1e-7)
        assert y[3:] == pytest.approx(paper.flip(point.Gamma) - lei_li.allocation[1:] @ u, rel=1e-7, abs=1e-8)


def test_parameters_are_the_coefficients(lei_li, residual, rng):
    theta = residual.theta * rng.uniform(0.5, 2, 5)
    other = blade_element_residual(lei_li, BladeCoefficients.from_parameters(theta))
    z = features([4.0, -2.0, 1.0], [2.0, 2.5, 3.0, 2.2])
    assert np.array(residual.function(z, theta)[0]).reshape(-1) == pytest.approx(other(z)[0], rel=1e-14)
    assert other.theta == pytest.approx(theta)


@pytest.mark.parametrize("u", [0.0, 1e-9, 0.0216, 0.0217])
@pytest.mark.parametrize("v", [(0, 0, 0), (1e-9, 0, 0), (0, 0, -8), (9, 0, 0), (0, 0, 12)])
def test_regular_at_rest_and_at_idle(residual, u, v):
    values = residual.function(features(v, np.full(4, u)), residual.theta)
    assert all(np.isfinite(value.full()).all() for value in values)


def test_below_idle_it_stays(lei_li, residual):
    """Rotors idle at 50 rad/s, 0.0217 N: below, value and derivative are those of the idle, and dy/du = 0."""
    idle = lei_li.thrust_coefficient * 50**2
    at_idle, below = (
        residual.function(features([3.0, 1, 0], np.full(4, u)), residual.theta) for u in (idle, 0.3 * idle)
    )
    assert np.array_equal(at_idle[0].full(), below[0].full())
    assert np.all(below[1].full()[:, 6:] == 0)


def test_above_idle_it_follows(lei_li, residual):
    """From 50 rad/s on every rotor's command counts."""
    z = features([3.0, 1, 0], lei_li.thrust_coefficient * np.array([50.5, 60, 200, 500]) ** 2)
    assert np.all(np.abs(residual.function(z, residual.theta)[1].full()[5, 6:]) > 1e-6)


def test_needs_a_rotor(vehicle, blade):
    with pytest.raises(UsageError, match=r"needs vehicle.rotor and vehicle.thrust_coefficient"):
        blade_element_residual(vehicle, blade)
