"""The IMU: what it reads in motions whose specific force is known, and the statistics of its noise."""

from __future__ import annotations

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.physics.state import RATE
from quadexp.world.inertial import means, read
from quadexp.world.motion_capture import ImuMocap
from tests.world.aided_flights import GRAVITY, AidedRun, motion, standing


def means_between(before: np.ndarray, after: np.ndarray, duration: float) -> np.ndarray:
    return np.array(ca.DM(means(ca.DM(before), ca.DM(after), duration, GRAVITY)).full()).ravel()


def test_at_rest_it_reads_gravity_upwards_in_body_axes():
    x = standing(np.zeros(1))[0]
    tilted = Rotation.from_euler("xyz", [0.3, -0.5, 2.0])
    x[3:7] = tilted.as_quat(scalar_first=True)
    assert np.allclose(means_between(x, x, 0.01), [*tilted.inv().apply([0, 0, GRAVITY]), 0, 0, 0])


def test_in_free_fall_it_reads_nothing():
    before, after = standing(np.zeros(2))
    after[9] -= GRAVITY * 0.01
    assert np.allclose(means_between(before, after, 0.01), 0, atol=1e-12)


def test_a_motion_is_read_to_second_order_in_the_interval():
    """Against the specific force R'(a - g) and the rates at the middle of the interval, with a from finite
    differences; a quarter of the interval leaves a sixteenth of the difference."""
    found = []
    for h in (0.04, 0.01):
        t = 0.7 + np.array([-h / 2, -1e-5, 0, 1e-5, h / 2])
        before, near, middle, beyond, after = motion(t, seed=5)
        force = (beyond[7:10] - near[7:10]) / 2e-5 + [0, 0, GRAVITY]
        truth = np.r_[Rotation.from_quat(middle[3:7], scalar_first=True).inv().apply(force), middle[RATE]]
        found.append(np.abs(means_between(before, after, h) - truth))
    assert found[1].max() < 0.02
    assert np.allclose(found[0] / found[1], 16, rtol=0.1)


def test_noise_and_walk_have_the_stated_densities():
    """Mean square of white noise over an interval h: density^2 / h; of a walk after t: density^2 t."""
    densities, h, runs, steps = np.array([2e-3, 1.7e-4, 3e-3, 1.9e-5]), 0.005, 400, 100
    symbols = [ca.SX.sym("b", 6), ca.SX.sym("n", 12)]
    one = ca.Function("read", symbols, list(read(ca.SX.zeros(6), symbols[0], h, symbols[1], ca.DM(densities))))
    noise, bias, white = np.random.default_rng(1).standard_normal((steps, 12, runs)), np.zeros((6, runs)), []
    for k in range(steps):
        reading, after = one(bias, noise[k])
        white.append(np.array(reading.full()) - bias)
        bias = np.array(after.full())
    spread = np.sqrt(np.mean(np.square(white), axis=(0, 2))).reshape(2, 3).mean(1)
    assert np.allclose(spread, densities[:2] / np.sqrt(h), rtol=0.02)
    assert np.allclose(
        np.sqrt(np.mean(bias.reshape(2, -1) ** 2, axis=1)), densities[2:] * np.sqrt(steps * h), rtol=0.08
    )


def test_biases_are_drawn_for_every_flight_and_read():
    sensors = ImuMocap(
        accelerometer_noise_density=0, gyroscope_noise_density=0, accelerometer_bias_walk=0, gyroscope_bias_walk=0
    )
    run = AidedRun(sensors)
    states = standing(np.arange(11))
    drawn = []
    for seed in range(200):
        run.go(states, seed)
        assert np.allclose(run.reading[-1], run.bias[-1, :3] + [0, 0, GRAVITY])
        drawn.append(run.bias[-1])
    spread = np.sqrt(np.mean(np.square(drawn).reshape(-1, 2, 3), axis=(0, 2)))
    assert np.allclose(spread, [sensors.accelerometer_bias_std, sensors.gyroscope_bias_std], rtol=0.1)
