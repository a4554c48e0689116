"""Identification from a recorded flight."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.log.schema import Flight
from quadexp.models.blade_element import FIRST_VALUES, OFFLINE, identify_flight
from quadexp.models.rls import BladeElementRLS, RLSSettings
from quadexp.physics.state import ATTITUDE, STATE_COLUMNS, VELOCITY
from tests.models.air_data import air_data


@pytest.fixture(scope="module")
def flight() -> Flight:
    """The air data as a flight would log it: world velocity, any attitude, noise of 0.05 m/s^2."""
    data, rng = air_data(800, period=0.02), np.random.default_rng(3)
    attitude = Rotation.from_euler("zyx", 0.3 * np.sin(data.t[:, None] * [0.5, 1, 2]))
    state = np.zeros((len(data.t), 13))
    state[:, ATTITUDE], state[:, VELOCITY] = attitude.as_quat(scalar_first=True), attitude.apply(data.velocity)
    columns = {"t": data.t, **dict(zip(STATE_COLUMNS, state.T, strict=True))}
    columns |= {f"rotor_speed_{i}": data.rotor_speed[:, i] for i in range(4)}
    force = data.specific_force + rng.normal(0, 0.05, data.specific_force.shape)
    columns |= {f"acc_{axis}": force[:, i] for i, axis in enumerate("xyz")}
    return Flight(columns, {"name": "lively"})


def test_estimates_and_confidence(lei_li, flight):
    found = identify_flight(flight, lei_li, settings=RLSSettings.scaled(gauss_newton=True, relative_std=2.0))
    truth = np.array([0.22, 3.32, 0.01, 0.01, 0.02])
    assert np.all(np.abs(found.raw[-1] - truth) < 4 * found.standard_error[-1])
    assert np.all(np.abs(found.fit.theta - truth) < 2 * found.fit.half_width)
    assert found.noise == pytest.approx(0.05, rel=0.1)
    assert found.raw.shape == found.theta.shape == found.standard_error.shape == (799, 5)
    assert np.all(found.standard_error[-1] < found.standard_error[50])


def test_is_the_estimator_sample_by_sample(lei_li, flight):
    found = identify_flight(flight, lei_li)
    estimator, data = BladeElementRLS(lei_li, FIRST_VALUES, OFFLINE), air_data(800, period=0.02)
    for k in range(1, 800):
        force = [flight[f"acc_{axis}"][k] for axis in "xyz"]
        estimator.update(data.velocity[k], data.rotor_speed[k], np.array(force))
    assert found.raw[-1] == pytest.approx(estimator.raw, rel=1e-9)


def test_without_enough_samples_no_interval_is_printed(lei_li, flight):
    short = Flight({name: column[:20] for name, column in flight.columns.items()}, flight.metadata)
    found = identify_flight(short, lei_li)
    assert found.fit is None and "19 samples, at least 28 are needed" in found.lines()[-1]
    assert not any("interval " in line for line in found.lines()[1:6])
    assert "interval_95" not in found.metadata() and found.metadata()["estimates"] == found.metadata()["recursion"]


def test_missing_and_damaged_columns(lei_li, flight):
    columns = dict(flight.columns)
    del columns["rotor_speed_2"]
    with pytest.raises(DataError, match="lively: column 'rotor_speed_2' is missing; identification needs"):
        identify_flight(Flight(columns, flight.metadata), lei_li)
    columns = dict(flight.columns)
    columns["acc_y"] = columns["acc_y"].copy()
    columns["acc_y"][17] = np.nan
    with pytest.raises(DataError, match="lively: acc is not finite at row 17"):
        identify_flight(Flight(columns, flight.metadata), lei_li)


def test_rotors_that_never_turn(lei_li, flight):
    columns = {name: 0 * values if name.startswith("rotor") else values for name, values in flight.columns.items()}
    with pytest.raises(DataError, match="the rotors do not turn"):
        identify_flight(Flight(columns, flight.metadata), lei_li)
