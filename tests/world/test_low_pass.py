"""A low pass has its stated cut-off and delay at every control rate and number of integration steps in a period."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.signal import freqz
from scipy.signal import group_delay as measured_delay

from quadexp.compile.symbolic import ca
from quadexp.physics.low_pass import group_delay, low_pass
from quadexp.physics.state import RATE
from quadexp.plugins.laws.cascade import filtered
from quadexp.world.effect import Effect
from quadexp.world.sensors import Sensors
from quadexp.world.world import World
from tests.world.airframes import REST, ideal

CUTOFF = 20.0
CLOCKS = [(50, 1), (50, 20), (100, 3), (200, 1), (500, 2), (1000, 1), (1000, 20)]  # rate (Hz), steps of a period


@dataclass(frozen=True, kw_only=True)
class Shaken(Effect):
    """A force along x and a torque about z that swing as a sine; force and rate grow evenly at a frequency of 0 Hz."""

    stage = "external"
    frequency: float = 0.0

    def wrench(self, at):
        swing = ca.sin(2 * math.pi * self.frequency * at.t)
        force, torque = (swing, swing) if self.frequency else (at.t, 1)
        return ca.vertcat(force, 0, 0), ca.vertcat(0, 0, 1e-3 * torque)


def readings(vehicle, sensors, frequency, rate, steps, seconds):
    """Times (s), specific force along x and rate about z that are given at the ends of periods in open loop."""
    world = World(ideal(vehicle, step=1 / rate / steps), [Shaken(frequency=frequency), sensors])
    noise, x, rows = world.begin(REST, 1 / rate, seconds, np.random.default_rng(0)), REST, []
    for k in range(round(seconds * rate)):
        x, force = world.advance(x, np.full(vehicle.n_rotors, vehicle.hover_thrust), 1 / rate, noise)
        rows.append([(k + 1) / rate, force[0], world.measured[RATE][2]])
    return np.array(rows).T


def phasors(t, values, frequency):
    """Of a sine of that frequency (Hz) in the second half, beside a constant."""
    late = t > t[-1] / 2
    angles = 2 * np.pi * frequency * t[late]
    basis = np.column_stack([np.cos(angles), np.sin(angles), np.ones(late.sum())])
    cosine, sine, _ = np.linalg.lstsq(basis, values[late], rcond=None)[0]
    return cosine - 1j * sine


@pytest.mark.parametrize(("rate", "steps"), CLOCKS)
def test_a_sine_at_the_cut_off_is_halved_in_power_by_the_running_sensors(vehicle, rate, steps):
    """Against the same flight without low passes."""
    behind = Sensors(accelerometer_cutoff=CUTOFF, gyroscope_cutoff=CUTOFF, gyroscope_noise=1e-12)
    exact = readings(vehicle, Sensors(), CUTOFF, rate, steps, 1.0)
    passed = readings(vehicle, behind, CUTOFF, rate, steps, 1.0)
    for before, after in zip(exact[1:], passed[1:], strict=True):
        gain = abs(phasors(exact[0], after, CUTOFF) / phasors(exact[0], before, CUTOFF))
        assert gain == pytest.approx(math.sqrt(0.5), rel=1e-3)


@pytest.mark.parametrize(("rate", "steps"), CLOCKS)
def test_a_ramp_is_as_late_as_the_data_sheet_states(vehicle, rate, steps):
    sensors = Sensors(accelerometer_cutoff=CUTOFF, gyroscope_cutoff=CUTOFF)
    world = World(ideal(vehicle), [sensors])
    exact = readings(vehicle, Sensors(), 0.0, rate, steps, 0.3)
    passed = readings(vehicle, sensors, 0.0, rate, steps, 0.3)
    slopes = (exact[1:, -1] - exact[1:, -2]) * rate
    ages = (exact[1:, -1] - passed[1:, -1]) / slopes
    stated = [sensor.delay for sensor in (world.sensor_spec.accelerometer, world.sensor_spec.gyroscope)]
    assert ages == pytest.approx(stated, rel=1e-3) and stated[0] == group_delay(CUTOFF)


@pytest.mark.parametrize("ratio", [1e-4, 0.01, 0.1, 0.3, 0.45, 0.499])
def test_the_coefficients_have_cut_off_and_delay(ratio):
    """ratio: of the cut-off to the rate of the steps. Against SciPy's frequency response and group delay."""
    decay, before, now = low_pass(ratio, 1.0)
    filtering = [now, before], [1, -decay]
    assert abs(freqz(*filtering, [2 * np.pi * ratio])[1][0]) == pytest.approx(math.sqrt(0.5), rel=1e-9)
    assert measured_delay(filtering, [1e-4 * ratio])[1][0] == pytest.approx(group_delay(ratio), rel=1e-6)
    assert now + before == pytest.approx(1 - decay, rel=1e-12) and abs(decay) < 1


@pytest.mark.parametrize("ratio", [0.5, 1.0, 50.0])
def test_a_cut_off_beyond_the_steps_leaves_its_delay(ratio):
    decay, before, now = low_pass(ratio, 1.0)
    assert decay == 0 and before == pytest.approx(group_delay(ratio)) and now == pytest.approx(1 - before)


@pytest.mark.parametrize("rate", [70, 200, 1000])
def test_the_filters_of_the_cascade_have_their_cut_off(rate):
    memory, told = 0.0, []
    t = np.arange(0, 2, 1 / rate)
    values = np.sin(2 * np.pi * 30 * t)
    for value in values:
        out, memory = filtered(memory, value, 30.0, 1 / rate)
        told.append(out)
    gain = abs(phasors(t, np.array(told), 30.0) / phasors(t, values, 30.0))
    assert gain == pytest.approx(math.sqrt(0.5), rel=1e-6)
