"""Random polynomials: reproducible, through their keypoints, at rest at the ends, of the size asked for."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.reference.base import sampled_peak_speed
from quadexp.reference.random_polynomial import RandomPolynomial, _periodic_draw


@pytest.mark.parametrize("seed", range(4))
def test_through_the_keypoints_in_the_specified_time(seed):
    trajectory = RandomPolynomial(speed=4.0, seed=seed)
    assert trajectory.waypoints.shape == (10, 3)
    np.testing.assert_allclose(trajectory.flat_output(trajectory.times).position[:, 0], trajectory.waypoints, atol=1e-8)
    np.testing.assert_array_equal(trajectory.waypoints[0], trajectory.waypoints[-1])
    np.testing.assert_allclose(np.diff(trajectory.times), trajectory.duration / 9)
    assert sampled_peak_speed(trajectory, 1e-4) == pytest.approx(4.0, rel=1e-6)


def test_rest_to_rest_and_smooth_to_the_snap():
    trajectory = RandomPolynomial(speed=4.0, seed=3)
    ends = trajectory.flat_output(np.array([0.0, trajectory.duration])).position
    np.testing.assert_allclose(ends[:, 1:4], 0, atol=1e-6)
    before, after = (trajectory.flat_output(trajectory.times[1:-1] + s * 1e-9).position for s in (-1, 1))
    scale = np.abs(trajectory.flat_output(np.linspace(0, trajectory.duration, 500)).position).max(axis=(0, 2))
    assert np.all(np.abs(after - before).max(axis=(0, 2)) < 1e-6 * scale)


def test_same_seed_same_numbers_and_speed_only_scales_time():
    one, two = RandomPolynomial(speed=4.0, seed=5), RandomPolynomial(speed=4.0, seed=5)
    t = np.linspace(0, one.duration, 50)
    np.testing.assert_array_equal(one.flat_output(t).position, two.flat_output(t).position)
    fast = RandomPolynomial(speed=8.0, seed=5)
    np.testing.assert_allclose(fast.flat_output(t / 2).position[:, 0], one.flat_output(t).position[:, 0], atol=1e-8)
    assert fast.peak_speed == pytest.approx(2 * one.peak_speed, rel=1e-9)
    assert not np.allclose(one.waypoints, RandomPolynomial(speed=4.0, seed=6).waypoints)


@pytest.mark.parametrize("seed", range(6))
def test_extent_and_clearance(seed):
    """The keypoints are a tenth of the path, so their mean range is somewhat below the path's 6 m."""
    trajectory = RandomPolynomial(speed=4.0, seed=seed, extent=6.0, clearance=1.5)
    assert 4.8 < np.ptp(trajectory.waypoints, axis=0).mean() <= 6.0 + 1e-12
    many = RandomPolynomial(speed=4.0, seed=seed, keypoints=101, extent=6.0)
    assert np.ptp(many.waypoints, axis=0).mean() == pytest.approx(6.0, abs=1e-9)
    height = trajectory.flat_output(np.linspace(0, trajectory.duration, 5000)).position[:, 0, 2]
    assert height.min() == pytest.approx(1.5, abs=1e-3)


def test_draws_have_the_periodic_kernel_as_covariance():
    """E[(f - mean)(f' - mean)] of exp(-2 sin^2(pi d) / l^2), over 20 000 draws; the constant part is left out."""
    rng = np.random.default_rng(0)
    phase, length = np.array([0.0, 0.1, 0.35]), 0.8
    draws = np.stack([_periodic_draw(phase, length, 1, rng) for _ in range(20000)])
    everywhere = np.linspace(0, 1, 2000, endpoint=False)
    constant = np.exp(-2 * np.sin(np.pi * everywhere) ** 2 / length**2).mean()
    expected = np.exp(-2 * np.sin(np.pi * (phase[:, None] - phase)) ** 2 / length**2) - constant
    np.testing.assert_allclose(draws.T @ draws / len(draws), expected, atol=0.02)
