"""Differences, integrals and interpolation on a time grid: exact where they should be, else of the stated order."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.reference.time_grid import SPACING, TimeGrid


def test_grid_covers_the_times_within_the_range():
    grid = TimeGrid.around(1.0, 2.0, 0.0, 10.0)
    assert grid.times[0] < 1.0 and grid.times[-1] > 2.0
    assert np.diff(grid.times).max() <= SPACING * (1 + 1e-9)
    tight = TimeGrid.around(0.0, 10.0, 0.0, 10.0)
    assert (tight.times[0], tight.times[-1]) == (0.0, 10.0)
    assert len(TimeGrid.around(4.0, 4.0, 0.0, 10.0).times) >= 9


def test_differences_are_exact_for_quartics_at_every_node():
    grid = TimeGrid.around(0.0, 0.1, 0.0, 0.1)
    t = grid.times
    first, second = grid.differentiate(np.stack([t**4 - 2 * t**3, t**2]))
    np.testing.assert_allclose(first, [4 * t**3 - 6 * t**2, 2 * t], atol=1e-12)
    np.testing.assert_allclose(second, [12 * t**2 - 12 * t, 0 * t + 2], atol=1e-9)


def test_interpolation_is_exact_for_quintics():
    grid = TimeGrid.around(0.0, 0.2, 0.0, 0.2)
    t = np.random.default_rng(0).uniform(0, 0.2, 50)
    value, first, second = grid.interpolate(grid.times[None] ** 5, t)
    np.testing.assert_allclose(value[0], t**5, atol=1e-15)
    np.testing.assert_allclose(first[0], 5 * t**4, atol=1e-12)
    np.testing.assert_allclose(second[0], 20 * t**3, atol=1e-9)


@pytest.mark.parametrize("what", ["first", "second", "integral"])
def test_order_four(what):
    def error(steps):
        t = np.linspace(0, 2, steps + 1)
        grid = TimeGrid(t, 2 / steps)
        first, second = grid.differentiate(np.sin(3 * t)[None])
        found = {"first": first[0], "second": second[0], "integral": grid.integrate(np.sin(3 * t), 3 * np.cos(3 * t))}
        exact = {"first": 3 * np.cos(3 * t), "second": -9 * np.sin(3 * t), "integral": (1 - np.cos(3 * t)) / 3}
        return np.abs(found[what] - exact[what])[2:-2].max()  # the ends are one-sided

    assert np.log2(error(40) / error(80)) == pytest.approx(4, abs=0.3)
