"""The accelerometer: bias and noise on every axis."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.experiment.build import build_sensor
from quadexp.parts.compose import compose
from quadexp.world.accelerometer import Accelerometer
from tests import paper

LEI_LI = build_sensor(compose(["sensor=lei_li"]).sensor)


def test_perfect_by_default(rng):
    force = rng.normal(size=3)
    assert np.array_equal(Accelerometer().read(force, rng.normal(size=3)), force)


def test_bias_and_noise(rng):
    sensor = Accelerometer(bias=(0.3, -0.2, 0.1), noise_std=(0.05, 0.1, 0.0))
    force = np.array([1.0, -2.0, 9.81])
    readings = sensor.read(force, rng.standard_normal((20000, 3))) - force
    assert readings.mean(0) == pytest.approx([0.3, -0.2, 0.1], abs=3e-3)
    assert readings.std(0) == pytest.approx([0.05, 0.1, 0.0], rel=0.03, abs=1e-9)
    assert np.corrcoef(readings[1:, 0], readings[:-1, 0])[0, 1] == pytest.approx(0, abs=0.03)


def test_numbers_of_the_paper():
    """B_accel = (.001, -.001, .001) in FRD, deviation .05 m/s^2."""
    assert paper.flip(LEI_LI.bias) == pytest.approx([0.001, -0.001, 0.001])
    assert LEI_LI.noise_std == (0.05, 0.05, 0.05)
