"""What is computed from neighbouring samples does not reach across a gap of a log, nor a reset of its estimator."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight
from quadexp.plugins.identification.thrust_curve import ThrustCurve
from quadexp.plugins.identification.validation import accelerometer_bias

BIAS = np.array([0.1, -0.2, 0.15])


def test_a_late_command_is_of_its_own_segment():
    signal, segment = np.arange(1.0, 21.0), np.repeat([0, 3], 10)
    columns = {"t": 0.01 * np.arange(20) + 5.0 * (segment > 0), "segment": segment}
    columns |= {f"motor_command_{i}": signal for i in range(4)}
    curve = ThrustCurve("motor_command", np.array([1.0]), np.array([2.0]), np.zeros(1), delay=0.03)
    first, second = 2 * signal[:10], 2 * signal[10:]
    late = np.concatenate([first[[0, 0, 0, *range(7)]], second[[0, 0, 0, *range(7)]]])
    assert curve.rotor_acceleration(Flight(columns, {}))[:, 0] == pytest.approx(late)


def moving(noise=0.0):
    """Times, velocity, attitude and specific force of 20 s of motion; its accelerometer has a bias."""
    t = 0.01 * np.arange(2000)
    R = Rotation.from_euler("zyx", np.column_stack([0.3 * t, 0.4 * np.sin(t), 0.3 * np.cos(1.3 * t)]))
    velocity = np.column_stack([3 * np.sin(t), 2 * np.cos(0.7 * t), np.sin(0.5 * t)])
    acceleration = np.column_stack([3 * np.cos(t), -1.4 * np.sin(0.7 * t), 0.5 * np.cos(0.5 * t)])
    force = R.inv().apply(acceleration + [0, 0, 9.81]) + BIAS
    return t, velocity, R.as_matrix(), force + noise * np.random.default_rng(0).standard_normal(force.shape)


@pytest.mark.parametrize("noise", [0.0, 0.5])
@pytest.mark.parametrize("marked", [False, True])
@pytest.mark.parametrize("jump", [-2.0, 0.5, 20.0])
def test_the_accelerometers_error_has_nothing_of_a_reset(noise, marked, jump):
    """The velocity is set anew twice; where the log says so, a segment begins there."""
    t, velocity, matrix, force = moving(noise)
    segment = np.zeros(len(t), int)
    for row in (700, 1500):
        velocity[row:] += [jump, -jump, jump / 2]
        segment[row:] += marked
    found = accelerometer_bias(t, velocity, matrix, force, segment)
    assert found == pytest.approx(BIAS, abs=2e-3 + 0.08 * noise)


def test_the_accelerometers_error_has_nothing_of_a_gap():
    """Of 8 s in the middle of a flight."""
    t, velocity, matrix, force = moving()
    kept = (t < 5) | (t > 13)
    segment = (t > 9).astype(int)
    found = accelerometer_bias(*(part[kept] for part in (t, velocity, matrix, force, segment)))
    assert found == pytest.approx(BIAS, abs=1e-3)
    alone = accelerometer_bias(*(part[np.r_[:500, 1500]] for part in (t, velocity, matrix, force, segment)))
    assert alone == pytest.approx(BIAS, abs=1e-3)  # a segment of one sample has no derivative
