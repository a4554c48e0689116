"""The accelerometer: bias and noise on every axis, the same for the same seed."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.config.compose import compose
from quadexp.errors import UsageError
from quadexp.experiment.build import build_sensor
from quadexp.world.accelerometer import Accelerometer
from tests import paper

LEI_LI = build_sensor(compose(["sensor=lei_li"]).sensor)


def test_perfect_by_default(rng):
    force = rng.normal(size=3)
    assert np.array_equal(Accelerometer().read(force, rng), force)


def test_bias_and_noise(rng):
    sensor = Accelerometer(bias=(0.3, -0.2, 0.1), noise_std=(0.05, 0.1, 0.0))
    force = np.array([1.0, -2.0, 9.81])
    readings = np.array([sensor.read(force, rng) for _ in range(20000)]) - force
    assert readings.mean(0) == pytest.approx([0.3, -0.2, 0.1], abs=3e-3)
    assert readings.std(0) == pytest.approx([0.05, 0.1, 0.0], rel=0.03, abs=1e-9)
    assert np.corrcoef(readings[1:, 0], readings[:-1, 0])[0, 1] == pytest.approx(0, abs=0.03)


def test_same_seed_same_readings():
    one, two = (
        [LEI_LI.read(np.zeros(3), generator) for _ in range(5)]
        for generator in (np.random.default_rng(4), np.random.default_rng(4))
    )
    assert np.array_equal(one, two)


def test_a_quiet_axis_leaves_the_others_alone():
    """Switching one axis' noise off does not change what the others draw: comparisons stay paired."""
    noisy, quiet = Accelerometer(noise_std=(0.1, 0.1, 0.1)), Accelerometer(noise_std=(0.1, 0.0, 0.1))
    a, b = (sensor.read(np.zeros(3), np.random.default_rng(1)) for sensor in (noisy, quiet))
    assert a[0] == b[0] and a[2] == b[2] and b[1] == 0


def test_numbers_of_the_paper():
    """B_accel = (.001, -.001, .001) in FRD, deviation .05 m/s^2."""
    assert paper.flip(LEI_LI.bias) == pytest.approx([0.001, -0.001, 0.001])
    assert LEI_LI.noise_std == (0.05, 0.05, 0.05)


@pytest.mark.parametrize("wrong", [{"noise_std": (0.1, -0.1, 0.1)}, {"bias": (np.nan, 0, 0)}])
def test_refused(wrong):
    with pytest.raises(UsageError, match="sensor.accelerometer"):
        Accelerometer(**wrong)
