"""Paths scaled in time: the limits are kept and reached, checked by the reference that is flown."""

from __future__ import annotations

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
from quadexp.reference.minimum_snap import largest_speed, minimum_snap
from quadexp.reference.motion import allocation_inverse
from quadexp.reference.random_polynomial import RandomPolynomial
from quadexp.reference.time_scale import MARGIN, time_scale

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
    assert thrust < 1 - MARGIN + 5e-3 and rate < 1 - MARGIN + 5e-3 and speed < 1 + 1e-9
    assert max(thrust / (1 - MARGIN), rate / (1 - MARGIN), speed) == pytest.approx(1.0, abs=5e-3)
    assert (path.note == "") == (speed > 1 - 1e-3)


def test_a_hundred_seeds_keep_every_limit_at_the_default():
    vehicle = VEHICLES["torrente"]
    for seed in range(100):
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
    assert time_scale(path, None, speed=7.0, margin=MARGIN).factor == pytest.approx(35 / 16 / 7)
