"""Polynomial paths: random and reproducible, through their points; scaled in time, the limits are kept and reached."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.parts.compose import compose
from quadexp.physics.state import RATE
from quadexp.reference.base import sampled_peak_speed
from quadexp.reference.flatness import flat_reference
from quadexp.reference.motion import allocation_inverse
from quadexp.reference.polynomial import largest_speed, minimum_snap, time_scale
from quadexp.reference.random_polynomial import RandomPolynomial, _periodic_draw

VEHICLES = {name: build_vehicle(compose([f"vehicle={name}"]).vehicle) for name in ("torrente", "lei_li", "crazyflie")}
# Heavy, with little thrust to spare, slow to turn, and with rotors that are never idle.
VEHICLES |= {
    "heavy": replace(VEHICLES["torrente"], name="heavy", mass=6.0),
    "weak": replace(VEHICLES["torrente"], name="weak", thrust_max=2.7),
    "slow": replace(VEHICLES["torrente"], name="slow", rate_max=1.0),
    "never idle": replace(VEHICLES["lei_li"], name="never idle", thrust_min=1.5),
}


def shares(trajectory, vehicle, step=1e-3):
    """Largest share used of the room between hover and a thrust limit, and of the largest body rate."""
    t = np.linspace(0.0, trajectory.duration, int(trajectory.duration / step) + 2)
    reference = flat_reference(trajectory, t, vehicle)
    hover = allocation_inverse(vehicle)[:, 0] * vehicle.mass * vehicle.gravity
    above = ((reference.input - hover) / (vehicle.thrust_max - hover)).max()
    below = ((hover - reference.input) / (hover - vehicle.thrust_min)).max()
    rate = np.linalg.norm(reference.state[:, RATE], axis=1).max() / vehicle.rate_max
    return max(above, below), rate


@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize("seed", [0, 11])
def test_limits_are_kept_and_one_of_them_reached(name, seed):
    """By the reference on a finer grid, found by other code than the scale."""
    vehicle = VEHICLES[name]
    path = RandomPolynomial(speed=8.0, seed=seed, vehicle=vehicle)
    thrust, rate = shares(path, vehicle)
    speed = sampled_peak_speed(path, 1e-3) / 8.0
    assert thrust < 0.75 + 5e-3 and rate < 0.75 + 5e-3 and speed < 1 + 1e-9
    assert max(thrust / 0.75, rate / 0.75, speed) == pytest.approx(1.0, abs=5e-3)
    assert (path.note == "") == (speed > 1 - 1e-3)


def test_many_seeds_keep_every_limit_at_the_default():
    vehicle = VEHICLES["torrente"]
    for seed in range(30):
        path = RandomPolynomial(speed=8.0, seed=seed, vehicle=vehicle)
        reference = flat_reference(path, np.arange(0.0, path.duration, 5e-3), vehicle)
        assert vehicle.thrust_min + 0.3 < reference.input.min() and reference.input.max() < vehicle.thrust_max - 3
        assert path.peak_speed <= 8.0 * (1 + 1e-9)


def test_the_vehicle_changes_the_time_and_not_the_shape():
    free = RandomPolynomial(speed=8.0, seed=1)
    bound = RandomPolynomial(speed=8.0, seed=1, vehicle=VEHICLES["torrente"])
    assert bound.duration > 1.01 * free.duration and free.peak_speed == pytest.approx(8.0)
    phase = np.linspace(0.0, 1.0, 300)
    a, b = (one.flat_output(phase * one.duration).position for one in (free, bound))
    np.testing.assert_allclose(a[:, 0], b[:, 0], atol=1e-9)
    ratio = bound.duration / free.duration
    for order in range(1, 5):
        np.testing.assert_allclose(
            a[:, order], b[:, order] * ratio**order, rtol=1e-9, atol=1e-7 * np.abs(a[:, order]).max()
        )


def test_hover_near_the_limit_is_named():
    path = RandomPolynomial(speed=8.0, vehicle=replace(VEHICLES["torrente"], thrust_max=2.5))
    assert path.peak_speed < 2.0
    assert (
        "hovering alone takes 98% of vehicle.thrust_max" in path.note and "instead of the requested 8 m/s" in path.note
    )


def test_a_rotor_that_cannot_hover_is_named(odd_vehicle):
    hover = allocation_inverse(odd_vehicle)[:, 0] * odd_vehicle.mass * odd_vehicle.gravity
    tight = replace(odd_vehicle, thrust_max=(hover.max() + hover.mean()) / 2)
    with pytest.raises(UsageError, match=rf"vehicle=odd: in hover rotor {np.argmax(hover)} needs"):
        _ = RandomPolynomial(speed=8.0, vehicle=tight).duration


@given(st.integers(0, 2**31), st.integers(2, 8), st.floats(1e-3, 1e3))
@settings(max_examples=25, deadline=None)
def test_largest_speed_is_that_of_a_fine_grid(seed, count, unit):
    rng = np.random.default_rng(seed)
    path = minimum_snap(unit * np.cumsum(rng.uniform(0.5, 2.0, count)), rng.normal(size=(count, 3)))
    t = np.linspace(path.x[0], path.x[-1], 20_001)
    speeds = np.linalg.norm(path.derivative()(t), axis=1)
    assert speeds.max() <= largest_speed(path) * (1 + 1e-9)
    assert largest_speed(path) == pytest.approx(speeds.max(), rel=1e-4)


def test_two_points_are_the_known_polynomial():
    """From rest to rest with zero jerk: p = 35 s^4 - 84 s^5 + 70 s^6 - 20 s^7, fastest in the middle with 35/16."""
    path = minimum_snap(np.array([3.0, 5.0]), np.array([[0.0, 0, 1], [2.0, 0, 1]]))
    s = np.linspace(0.0, 1.0, 50)
    np.testing.assert_allclose(path(3 + 2 * s)[:, 0], 2 * (35 * s**4 - 84 * s**5 + 70 * s**6 - 20 * s**7), atol=1e-9)
    assert largest_speed(path) == pytest.approx(35 / 16)
    assert time_scale(path, None, speed=7.0, margin=0.25).factor == pytest.approx(35 / 16 / 7)


# ------------------------------------------------------------------------------------------------------- random paths
def keypoints(path):
    return path._keypoints + [0.0, 0.0, path._lift]


@pytest.mark.parametrize("seed", range(4))
def test_through_the_keypoints_at_even_times_at_rest_at_the_ends_and_smooth_to_the_snap(seed):
    path = RandomPolynomial(speed=4.0, seed=seed)
    times, points = np.linspace(0, path.duration, 10), keypoints(path)
    np.testing.assert_allclose(path.flat_output(times).position[:, 0], points, atol=1e-8)
    np.testing.assert_array_equal(points[0], points[-1])
    assert sampled_peak_speed(path, 1e-4) == pytest.approx(4.0, rel=1e-6)
    np.testing.assert_allclose(path.flat_output(times[[0, -1]]).position[:, 1:4], 0, atol=1e-6)
    before, after = (path.flat_output(times[1:-1] + s * 1e-9).position for s in (-1, 1))
    scale = np.abs(path.flat_output(np.linspace(0, path.duration, 500)).position).max(axis=(0, 2))
    assert np.all(np.abs(after - before).max(axis=(0, 2)) < 1e-6 * scale)


def test_same_seed_same_numbers_and_speed_only_scales_time():
    one, two, fast = (RandomPolynomial(speed=speed, seed=5) for speed in (4.0, 4.0, 8.0))
    t = np.linspace(0, one.duration, 50)
    np.testing.assert_array_equal(one.flat_output(t).position, two.flat_output(t).position)
    np.testing.assert_allclose(fast.flat_output(t / 2).position[:, 0], one.flat_output(t).position[:, 0], atol=1e-8)
    assert fast.peak_speed == pytest.approx(2 * one.peak_speed, rel=1e-9)
    assert not np.allclose(keypoints(one), keypoints(RandomPolynomial(speed=4.0, seed=6)))


@pytest.mark.parametrize("seed", range(3))
def test_extent_and_clearance(seed):
    """The keypoints are a tenth of the path, so their mean range is somewhat below the path's 6 m."""
    path = RandomPolynomial(speed=4.0, seed=seed, extent=6.0, clearance=1.5)
    assert 4.8 < np.ptp(keypoints(path), axis=0).mean() <= 6.0 + 1e-12
    many = RandomPolynomial(speed=4.0, seed=seed, keypoints=101, extent=6.0)
    assert np.ptp(many._keypoints, axis=0).mean() == pytest.approx(6.0, abs=1e-9)
    height = path.flat_output(np.linspace(0, path.duration, 5000)).position[:, 0, 2]
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
