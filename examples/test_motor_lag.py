"""What a plant must do: obey mechanics, forget earlier flights, and say what its accelerometer reads."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quadexp as qx

HERE = Path(__file__).parent
VELOCITY, ATTITUDE = slice(7, 10), slice(3, 7)


@pytest.fixture
def plant():
    return qx.controller("plant=motor_lag", {"plant.drag": [0, 0, 0]}, conf=HERE).plant


def advance(plant, thrust_ratio, duration, steps=1):
    """From hover at rest, at this multiple of the hover thrust; the state (13,) and the reading (3,) at the end."""
    x = np.array([0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    u = np.full(plant.vehicle.n_rotors, thrust_ratio * plant.vehicle.hover_thrust)
    plant.reset()
    for _ in range(steps):
        x, reading = plant.advance(x, u, duration / steps, np.random.default_rng(0))
    return x, reading


def test_the_thrust_follows_with_its_lag(plant):
    """The closed solution of a step: T = T0 + dT (1 - exp(-t / tau)), v = dT / m (t - tau (1 - exp(-t / tau)))."""
    tau, t, g = 0.03, 0.06, plant.vehicle.gravity
    x, reading = advance(plant, 1.5, t)
    arrived = 1 - np.exp(-t / tau)
    np.testing.assert_allclose(reading, [0, 0, g * (1 + 0.5 * arrived)], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(x[VELOCITY], [0, 0, 0.5 * g * (t - tau * arrived)], rtol=1e-6, atol=1e-9)


def test_many_control_periods_are_one_long_one(plant):
    np.testing.assert_allclose(advance(plant, 1.2, 0.1, steps=5)[0], advance(plant, 1.2, 0.1)[0], rtol=1e-9, atol=1e-12)


def test_the_accelerometer_reads_what_the_velocity_changes_by(plant):
    before, after = advance(plant, 1.5, 0.0999)[0], advance(plant, 1.5, 0.1001)[0]
    x, reading = advance(plant, 1.5, 0.1)
    world = Rotation.from_quat(x[ATTITUDE], scalar_first=True).apply(reading) - [0, 0, plant.vehicle.gravity]
    np.testing.assert_allclose((after - before)[VELOCITY] / 2e-4, world, rtol=1e-3, atol=1e-6)


def test_it_can_be_flown_and_its_equations_do_no_harm():
    """perfect_mpc is given residual(), nominal_mpc is not. Where there is little air, both fly the same."""
    nominal, perfect = (
        qx.simulate("plant=motor_lag", f"controller={name}", "trajectory=circle", speed=4, conf=HERE)
        for name in ("nominal_mpc", "perfect_mpc")
    )
    assert perfect.outcome == nominal.outcome == "ok"
    assert perfect.metrics["mean_error"] < nominal.metrics["mean_error"] + 1e-3  # m
