"""What a trajectory must be: smooth up to the snap, at rest at its ends, as fast as it says, and flyable."""

from pathlib import Path

import numpy as np
from helix import HelixTrajectory

import quadexp as qx

HERE = Path(__file__).parent
SPEED = 4.0  # m/s


def sampled():
    trajectory = HelixTrajectory(speed=SPEED)
    t = np.linspace(0.0, trajectory.duration, 4001)
    return trajectory, t, trajectory.flat_output(t).position  # (4001, 5, 3)


def test_each_derivative_is_that_of_the_one_before():
    """Differential flatness takes attitude from the acceleration, and torques from the snap: both must be right."""
    _, t, position = sampled()
    for order in range(4):
        slope = np.gradient(position[:, order], t, axis=0, edge_order=2)
        scale = np.abs(position[:, order + 1]).max()
        assert np.abs(slope - position[:, order + 1])[2:-2].max() < 1e-4 * scale


def test_it_begins_and_ends_at_rest():
    trajectory, _, position = sampled()
    assert np.abs(position[[0, -1], 1:]).max() < 1e-9
    before, after = trajectory.flat_output(np.array([-1.0, trajectory.duration + 1.0])).position
    np.testing.assert_allclose([before, after], position[[0, -1]], atol=1e-9)


def test_it_is_as_fast_as_it_says():
    trajectory, _, position = sampled()
    fastest = np.linalg.norm(position[:, 1], axis=1).max()
    np.testing.assert_allclose(fastest, trajectory.peak_speed, rtol=1e-6)
    np.testing.assert_allclose(fastest, SPEED, rtol=1e-6)


def test_it_can_be_flown():
    """Without air and noise, by a controller that knows that: what is left is discretisation."""
    settings = ("trajectory=helix", "plant=ideal", "controller=perfect_mpc")
    flight = qx.simulate(*settings, speed=SPEED, conf=HERE)
    assert flight.outcome == "ok" and flight.metrics["mean_error"] < 2e-3  # m
