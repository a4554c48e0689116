"""Strapdown propagation against SciPy's integration of the same motion, and what a bias leaves."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from quadexp.control.base import Measurement, Window
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.plugins.remedies.delay.strapdown import Strapdown, propagation
from tests.control.held import Held

PERIOD, GRAVITY = 0.02, 9.81
WINDOW = Window(np.zeros((1, 13)), np.zeros((0, 4)), np.zeros((5, 3)), np.zeros(3))


class Motion:
    """Rates and specific forces given in closed form, and the states that they make, from SciPy."""

    def __init__(self, seed, amplitude, frequency) -> None:
        rng = np.random.default_rng(seed)
        self.a, self.b = amplitude * rng.normal(size=(2, 3)), frequency * rng.uniform(0.5, 1, size=(2, 3))
        self.phase = rng.uniform(0, 6, (2, 3))
        x = np.concatenate([rng.normal(size=3), Rotation.random(random_state=seed).as_quat(), rng.normal(size=3)])
        self._found = solve_ivp(self._slope, (0, 1), x, rtol=1e-11, atol=1e-12, dense_output=True).sol

    def rate(self, t):
        return self.a[0] * np.sin(self.b[0] * t + self.phase[0])

    def force(self, t):
        return np.array([0, 0, GRAVITY]) + 3 * self.a[1] * np.sin(self.b[1] * t + self.phase[1])

    def _slope(self, t, x):
        w = Rotation.from_quat(x[3:7])
        q = 0.5 * np.concatenate([x[6] * self.rate(t) + np.cross(x[3:6], self.rate(t)), [-x[3:6] @ self.rate(t)]])
        return np.concatenate([x[7:], q, w.apply(self.force(t)) - [0, 0, GRAVITY]])

    def state(self, t):
        x = self._found(t)
        q = x[3:7] / np.linalg.norm(x[3:7])
        return np.concatenate([x[:3], q[[3, 0, 1, 2]], x[7:], self.rate(t)])

    def late(self, t, delay):
        """Measured at t: the state of t - delay, from the start on, with the rate of now."""
        return np.concatenate([self.state(max(t - delay, 0.0))[:10], self.rate(t)])


def flown(vehicle, motion, delay, believed=None, bias=0.0, periods=20):
    """States that the controller is given at each instant, (k, 13), and the true ones."""
    told = Held(vehicle, np.zeros(4), PERIOD)
    wrapped = Strapdown(time=delay if believed is None else believed).around(told)
    wrapped.reset(motion.state(0.0), WINDOW)
    for k in range(periods):
        t = k * PERIOD
        force = motion.force(t) + bias if k else None
        wrapped.step(Measurement(t, motion.late(t, delay), force, None), WINDOW)
    return told.states, np.array([motion.state(k * PERIOD) for k in range(periods)])


@pytest.mark.parametrize("delay", [0.01, 0.02, 0.033, 0.05])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_state_of_now_is_found(vehicle, delay, seed):
    """Readings that change slowly within a period: only the error of taking them as linear is left. At the start there
    is no specific force yet, and the first one counts for it."""
    told, true = flown(vehicle, Motion(seed, 1.0, 4.0), delay)
    assert np.abs(told - true)[:5, POSITION].max() < 1e-4
    error = np.abs(told - true)[5:]
    moved = np.abs(true[5:, POSITION] - true[4:-1, POSITION]).max()
    assert error[:, POSITION].max() < 2e-5 and error[:, VELOCITY].max() < 1e-3 and moved > 1e-2
    assert error[:, ATTITUDE].max() < 1e-4 and np.array_equal(told[:, RATE], true[:, RATE])


def test_the_error_falls_with_the_square_of_the_period(vehicle):
    """Linear readings: second order in the control period, for attitude and velocity alike."""
    errors = []
    for period in (0.02, 0.01):
        motion, told = Motion(3, 2.0, 5.0), Held(vehicle, np.zeros(4), period)
        wrapped = Strapdown(time=0.06).around(told)
        wrapped.reset(motion.state(0.0), WINDOW)
        times = np.arange(round(0.6 / period)) * period
        for t in times:
            wrapped.step(Measurement(t, motion.late(t, 0.06), motion.force(t) if t else None, None), WINDOW)
        errors.append(np.abs(told.states - [motion.state(t) for t in times])[8:].max(axis=0))
    assert np.all(errors[1][3:10] < errors[0][3:10] / 3)


def test_linear_readings_are_exact_to_the_order_of_the_formula():
    """One period with a rate and a force that are linear in time, at right angles: coning counts."""
    w, f, h = np.array([[2.0, 0, 0], [0, 3.0, 1]]), np.array([[0.0, 4, 9], [3, -2, 12]]), PERIOD
    x = np.zeros(13)
    x[3], x[7:10] = 1.0, [1, 2, 3]

    def slope(t, s):
        rate, force = ((v[0] + (v[1] - v[0]) * t / h) for v in (w, f))
        q = s[3:7]
        turn = 0.5 * np.concatenate([[-q[1:] @ rate], q[0] * rate + np.cross(q[1:], rate)])
        a = Rotation.from_quat(q, scalar_first=True).apply(force) - [0, 0, GRAVITY]
        return np.concatenate([s[7:], turn, a])

    true = solve_ivp(slope, (0, h), x[:10], rtol=1e-12, atol=1e-13).y[:, -1]
    found = np.array(propagation(1, GRAVITY, h)(x, w.T, f.T, h)).ravel()
    assert np.abs(found[3:7] - true[3:7]).max() < 1e-6  # 1e-4 without the coning term
    assert np.abs(found[7:10] - true[7:10]).max() < 5e-6 and np.abs(found[:3] - true[:3]).max() < 1e-6


@pytest.mark.parametrize("delay", [0.02, 0.05])
def test_what_a_bias_of_the_accelerometer_leaves(vehicle, delay):
    """b tau^2 / 2 in the position and b tau in the velocity, turned into the world."""
    motion, bias = Motion(5, 0.5, 3.0), np.array([0.4, -0.3, 0.8])
    with_bias, _ = flown(vehicle, motion, delay, bias=bias)
    without, _ = flown(vehicle, motion, delay)
    found, late = (with_bias - without)[8:], round(delay / PERIOD + 0.49)
    for k, one in enumerate(found, start=8):
        turned = Rotation.from_quat(motion.state(k * PERIOD - delay)[ATTITUDE], scalar_first=True).apply(bias)
        assert np.allclose(one[POSITION], turned * delay**2 / 2, atol=0.03 * delay**2), late
        assert np.allclose(one[VELOCITY], turned * delay, atol=0.05 * delay)


def test_before_the_delay_has_passed_the_start_is_what_is_measured(vehicle):
    """At first the measured state is younger than the delay, and must not be propagated by all of it."""
    told, true = flown(vehicle, Motion(7, 1.0, 4.0), 0.09, periods=4)
    assert np.abs(told - true)[:, :10].max() < 5e-3


def test_a_delay_of_none_is_the_measurement_itself(vehicle):
    told, true = flown(vehicle, Motion(1, 1.0, 4.0), 0.0)
    assert np.array_equal(told, true)
