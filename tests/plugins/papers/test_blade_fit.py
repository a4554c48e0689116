"""Blade-element coefficients of a whole flight: the truth is in the intervals, in flights and in repeated readings."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import fly_one
from quadexp.log.schema import Flight
from quadexp.parts.compose import session
from quadexp.physics.rotor import THETA
from quadexp.physics.state import ATTITUDE, STATE_COLUMNS, VELOCITY
from quadexp.plugins.papers.lei_li.blade_element import FIRST_VALUES, OFFLINE, fit_blade_element, identify_flight
from quadexp.plugins.papers.lei_li.rls import RLSSettings
from tests import paper
from tests.models.air_data import air_data
from tests.plugins.papers.estimator import Estimator
from tests.slow import slow

TRUE = np.array([0.22, 3.32, 0.01, 0.01, 0.02])  # of Lei & Li 2017, Table 1
REPETITIONS = 40
LEAST_HELD = 36  # 90 %


def saturated_count(fits) -> np.ndarray:
    """In how many fits each interval holds the truth, (5,)."""
    return sum((np.abs(fit.theta - TRUE) <= fit.half_width).astype(int) for fit in fits)


@pytest.mark.parametrize(("memory", "offset"), [(0.0, 0.0), (0.9, 0.05), *slow((0.9, 0.0), (0.0, 0.05))])
def test_intervals_hold_the_truth_in_nine_of_ten_repetitions(lei_li, memory, offset):
    """Forces computed by tests.paper; noise with and without a memory, an accelerometer with and without an offset."""
    data, fits = air_data(600, period=0.03), []
    for seed in range(REPETITIONS):
        rng = np.random.default_rng(seed)
        noise = lfilter([0.05], [1, -memory], rng.normal(size=data.specific_force.shape), axis=0)
        force = data.specific_force + noise + offset * rng.normal(size=3)
        fits.append(fit_blade_element(lei_li, data.velocity, data.rotor_speed, force, FIRST_VALUES))
    assert np.all(saturated_count(fits) >= LEAST_HELD), dict(zip(THETA, saturated_count(fits), strict=True))
    half = np.mean([fit.half_width for fit in fits], axis=0)
    scatter = 1.96 * np.std([fit.theta for fit in fits], axis=0)
    assert np.all(half < 2 * scatter), "intervals that hold the truth because they are far too wide"


FLIGHTS = {
    "rectangle": ("trajectory=rectangle", "trajectory.duration=16", "controller=rls_feedback"),
    "lemniscate": ("trajectory=lemniscate", "trajectory.speed=6", "controller=perfect_mpc"),
    "circle": ("trajectory=circle", "trajectory.speed=8", "controller=nominal_mpc"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FLIGHTS)
def test_intervals_hold_the_truth_in_flown_repetitions(name):
    """The readings of Lei & Li's accelerometer, whose offset nobody tells the fit."""
    fits = []
    with session(None) as composer:
        for seed in range(REPETITIONS):
            overrides = ["vehicle=lei_li", "plant=blade_element", "sensor=lei_li", *FLIGHTS[name], f"seed={seed}"]
            config = composer.compose(overrides)
            fits.append(identify_flight(fly_one(config), build_vehicle(config.vehicle)).fit)
    assert np.all(saturated_count(fits) >= LEAST_HELD), dict(zip(THETA, saturated_count(fits), strict=True))


def test_is_exact_without_noise_from_far_away(lei_li):
    data = air_data(300)
    fit = fit_blade_element(lei_li, data.velocity, data.rotor_speed, data.specific_force, FIRST_VALUES)
    assert fit.theta == pytest.approx(TRUE, rel=1e-4)
    assert fit.offset == pytest.approx(np.zeros(3), abs=1e-6) and fit.noise < 1e-5


def test_the_derivative_is_the_whole_one(lei_li):
    """Through the induced velocity, on all axes; here by differences."""
    from quadexp.plugins.papers.lei_li.blade_element import _force_function

    function, data, step = _force_function(lei_li), air_data(8), 1e-6
    for v, w in zip(data.velocity, data.rotor_speed, strict=True):
        slope = np.array(function(v, w, TRUE)[1])
        for j in range(5):
            change = step * np.eye(5)[j]
            ends = [np.array(function(v, w, TRUE + sign * change)[0]).ravel() for sign in (1, -1)]
            assert slope[:, j] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5, abs=1e-7)


def test_what_the_flight_does_not_tell_has_a_wide_interval(lei_li):
    """Never flown sideways: C_Dy could be anything; what the other axes tell stays sharp."""
    data, rng = air_data(600, period=0.03), np.random.default_rng(1)
    velocity = data.velocity * [1, 0, 1]
    exact = paper.flip(
        np.array([paper.point(paper.flip(v), w).F / paper.M for v, w in zip(velocity, data.rotor_speed, strict=True)])
    )
    fit = fit_blade_element(lei_li, velocity, data.rotor_speed, exact + rng.normal(0, 0.05, exact.shape), FIRST_VALUES)
    assert fit.half_width[3] > 10 * TRUE[3] > 5 * fit.half_width[2]
    assert np.all(np.abs(fit.theta - TRUE) <= 1.5 * fit.half_width)


def test_too_few_samples_give_no_interval(lei_li):
    data = air_data(20)
    with pytest.raises(DataError, match="20 samples, at least 28 are needed for intervals"):
        fit_blade_element(lei_li, data.velocity, data.rotor_speed, data.specific_force, FIRST_VALUES)


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
    estimator, data = Estimator(lei_li, FIRST_VALUES, OFFLINE), air_data(800, period=0.02)
    for k in range(1, 800):
        force = [flight[f"acc_{axis}"][k] for axis in "xyz"]
        estimator.update(data.velocity[k], data.rotor_speed[k], np.array(force))
    assert found.raw[-1] == pytest.approx(estimator.raw, rel=1e-9)


def test_missing_and_damaged_columns(lei_li, flight):
    columns = dict(flight.columns)
    del columns["rotor_speed_2"]
    with pytest.raises(DataError, match="lively: column 'rotor_speed_2' is missing; identification needs"):
        identify_flight(Flight(columns, flight.metadata), lei_li)
    columns = dict(flight.columns)
    columns["acc_y"] = columns["acc_y"].copy()
    columns["acc_y"][17] = np.nan
    with pytest.raises(DataError, match="lively: column 'acc_y' is not finite in row 17"):
        identify_flight(Flight(columns, flight.metadata), lei_li)


def test_rotors_that_never_turn(lei_li, flight):
    columns = {name: 0 * values if name.startswith("rotor") else values for name, values in flight.columns.items()}
    with pytest.raises(DataError, match="the rotors do not turn"):
        identify_flight(Flight(columns, flight.metadata), lei_li)
