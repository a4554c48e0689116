"""Residual rows of recorded flights, trims, tracking and validation against flights whose model is known."""

from dataclasses import replace

import numpy as np
import pytest

from quadexp.errors import DataError, UsageError
from quadexp.models.base import rms
from quadexp.models.common_scale import with_common_scale
from quadexp.models.linear_drag import fit_linear_drag
from quadexp.plugins.gaussian_process.gaussian_process import GPConfig, fit_gp
from quadexp.plugins.identification.lines import validation_lines
from quadexp.plugins.identification.predictors import nominal, predictors
from quadexp.plugins.identification.recorded import force_rows, logged_thrust, recorded_dataset, tracked_scale
from quadexp.plugins.identification.thrust_curve import ThrustCurve
from quadexp.plugins.identification.validation import Residuals, Track, residuals, rollout_errors, score_rows
from quadexp.plugins.identification.vehicle_model import FitSettings, fit_vehicle_model
from quadexp.plugins.logs.samples import read_rows
from tests.models.recorded_flights import CURVE, DRAG, OFFSET, crazyflie, recorded_flight

VEHICLE = crazyflie()
TRUE_CURVE = ThrustCurve("motor_command", np.array([1.0]), np.array([CURVE]), np.zeros(1))
SETTINGS = GPConfig(
    features={"a_x": ("v_x",), "a_y": ("v_y",)},
    method="subset",
    inducing=60,
    mean="linear_drag",
    max_rows=60,
    holdout=0.5,
)


@pytest.fixture(scope="module")
def flights():
    return [recorded_flight(seed, VEHICLE) for seed in range(3)]


def test_rows_are_the_drag_and_the_offset(flights):
    rows = force_rows(replace(flights[0], columns=dict(flights[0].columns)), VEHICLE, TRUE_CURVE)
    for i, axis in enumerate("xyz"):
        expected = -DRAG[i] * rows[f"v_{axis}"] + OFFSET[i]
        assert np.std(rows[f"a_{axis}"] - expected) == pytest.approx(0.02, rel=0.1)
        assert abs(np.mean(rows[f"a_{axis}"] - expected)) < 0.003
    assert rows["u_2"] == pytest.approx(VEHICLE.mass * CURVE * flights[0]["motor_command_2"], rel=1e-12)
    assert rows["thrust"] == pytest.approx(4 * rows["u_0"], rel=1e-12)


def test_velocity_is_relative_to_the_air():
    flight = recorded_flight(5, VEHICLE, wind=(3.0, -2.0, 0.5))
    drag = fit_linear_drag(recorded_dataset([flight], VEHICLE, TRUE_CURVE), thrust=False, loss="squares")
    assert drag.drag == pytest.approx(DRAG, abs=0.01)
    ground = replace(flight, columns={k: v for k, v in flight.columns.items() if not k.startswith("wind")})
    wrong = fit_linear_drag(recorded_dataset([ground], VEHICLE, TRUE_CURVE), thrust=False, loss="squares")
    assert abs(wrong.intercept[0] - OFFSET[0]) > 0.5  # what a log without its wind does to the fit
    by_velocity = recorded_dataset([flight], VEHICLE, TRUE_CURVE, target="velocity")
    assert fit_linear_drag(by_velocity, thrust=False, loss="squares").drag == pytest.approx(DRAG, abs=0.01)


def test_commands_without_a_curve_are_refused(flights):
    with pytest.raises(UsageError, match="collect.identified"):
        logged_thrust(flights, VEHICLE)


def test_missing_and_damaged_columns_are_named(flights):
    columns = dict(flights[0].columns)
    without = {name: values for name, values in columns.items() if name != "w_y"}
    with pytest.raises(DataError, match="w_y"):
        force_rows(replace(flights[0], columns=without), VEHICLE, TRUE_CURVE)
    broken = columns | {"acc_z": np.where(np.arange(1200) == 7, np.nan, columns["acc_z"])}
    with pytest.raises(DataError, match="acc_z.*row 7"):
        force_rows(replace(flights[0], columns=broken), VEHICLE, TRUE_CURVE)


def test_each_flights_thrust_scale_is_found():
    scales = (0.97, 1.02, 1.05)
    flights = [recorded_flight(seed, VEHICLE, scale=scale) for seed, scale in enumerate(scales)]
    found = with_common_scale(recorded_dataset(flights, VEHICLE, TRUE_CURVE))
    assert [found.errors[i] for i in range(3)] == pytest.approx([scale - 1 for scale in scales], abs=0.002)
    assert np.sqrt(found.variance) / found.level == pytest.approx(np.std(scales, ddof=1), rel=0.05)
    fitted = fit_gp(recorded_dataset(flights, VEHICLE, TRUE_CURVE), replace(SETTINGS, features={"a_z": ("v_z",)}))
    (output,) = fitted.outputs  # what nobody can know of the next flight is in the predicted variance
    assert output.noise_variance == pytest.approx(found.variance + 0.02**2, rel=0.1)


def test_tracking_finds_a_scale_from_the_past_alone():
    rng = np.random.default_rng(1)
    c = 10 + rng.standard_normal(6000)
    y = 0.95 * c + 0.05 * rng.standard_normal(6000)
    g = tracked_scale(c, y, 0.01)
    assert g[0] == 1.0
    assert g[3000:] == pytest.approx(0.95, abs=0.002)
    later = y.copy()
    later[2000:] += 5
    assert np.array_equal(tracked_scale(c, later, 0.01)[:2001], g[:2001])  # no sample is used for itself or before
    ground = np.zeros(1500)
    on_ground_first = tracked_scale(np.concatenate([ground, c]), np.concatenate([ground + 9.81, y]), 0.01)
    assert (on_ground_first[:1501] == 1.0).all() and on_ground_first[1500:] == pytest.approx(g, rel=1e-12)
    assert (tracked_scale(ground, ground, 0.01) == 1.0).all()


def test_validation_scores_are_the_known_errors(flights):
    model = fit_vehicle_model(flights[:2], VEHICLE, FitSettings(powers=(1,), kinds=("linear",)))
    test = recorded_flight(9, VEHICLE, scale=0.96, duration=40)
    rows = [read_rows(test, "test", "motor_command")]
    found = {one.name: residuals([(one, row) for row in rows]) for one in predictors(model, "x", VEHICLE, None)}
    drag = found["linear drag"]
    assert np.sqrt(np.mean(drag.error[:, 0] ** 2)) == pytest.approx(0.02, rel=0.1)
    assert np.sqrt(np.mean(drag.error[:, 2] ** 2)) == pytest.approx(0.04 * 9.81, rel=0.1)
    assert np.sqrt(np.mean(drag.tracked[1000:, 2] ** 2)) == pytest.approx(0.02, rel=0.15)
    scores = score_rows(list(found.values()))
    plain = next(row for row in scores if row["predictor"] == "linear drag" and not row["thrust_tracked"])
    assert plain["rms_low"] <= plain["rms"] <= plain["rms_high"]
    assert plain["share"] == pytest.approx(rms(drag.error) / rms(found["nominal"].error))


@pytest.mark.parametrize(
    ("flights", "spread", "lengths"),
    [(3, 0.0, "equal"), (3, 0.2, "drawn"), (4, 0.4, "one of ten times"), (5, 0.05, "equal"), (9, 0.2, "drawn")],
)
def test_the_interval_of_a_validation_is_over_flights(flights, spread, lengths):
    """Flights differ from one another by `spread`: 95 % intervals of RMS and ratio contain those of flights in general.

    It was 33 to 44 % of them by blocks of time. 80 trials: a standard deviation of 95 % is 2.4 %."""
    rng, trials, held = np.random.default_rng([flights, int(100 * spread), len(lengths)]), 80, np.zeros(2)
    for _ in range(trials):
        samples = {
            "equal": np.full(flights, 60),
            "one of ten times": np.r_[600, np.full(flights - 1, 60)],
            "drawn": rng.integers(20, 200, flights),
        }[lengths]
        flight = np.repeat(np.arange(flights), samples)
        factor = np.exp(spread * rng.normal(size=flights))[flight][:, None]
        error, base = (scale * rng.normal(size=(len(flight), 3)) for scale in (factor, np.ones((1, 1))))
        plain = [flight, flight, np.zeros(len(flight))]
        results = [Residuals(name, e, e, *plain, None) for name, e in (("nominal", base), ("drag", error))]
        row = score_rows(results)[2]
        truth = np.exp(spread**2)  # sqrt(mean of exp(2 spread z))
        held += row["rms_low"] <= np.sqrt(3) * truth <= row["rms_high"], row["share_low"] <= truth <= row["share_high"]
    assert np.all(held / trials >= 0.90 - 0.03) and np.all(held / trials <= 1.0)


@pytest.mark.parametrize("flights", [1, 2])
def test_fewer_than_three_flights_are_for_these_only(flights):
    rng, flight = np.random.default_rng(0), np.repeat(np.arange(flights), 600)
    error = rng.normal(size=(len(flight), 3))
    block = np.arange(len(flight)) // 20
    (row, _) = score_rows([Residuals("nominal", error, error, flight, block, np.zeros(len(flight)), None)])
    assert 0.9 * row["rms"] < row["rms_low"] < row["rms"] < row["rms_high"] < 1.1 * row["rms"]
    report = {
        "rows": [row, {**row, "thrust_tracked": True}],
        "bands": [],
        "rollouts": [],
        "notes": [],
        "torque": {"note": ""},
    }
    texts = [
        "\n".join(validation_lines({**report, "flights": "abc"[:n], "leave_one_out": False})) for n in (flights, 3)
    ]
    assert "of these flights only" in texts[0] and "3 flights or more" in texts[0] and "over 3 flights" in texts[1]


def test_open_loop_with_the_true_model_stays_on_the_flight(flights):
    model = fit_vehicle_model(flights, VEHICLE, FitSettings(powers=(1,), kinds=("linear",)))
    row = read_rows(flights[0], "flight", "motor_command")
    nothing, drag = nominal(model.thrust), predictors(model, "x", VEHICLE, None)[1]
    errors = {one.name: rollout_errors([Track(row, one)], [0.1, 1.0], tracked=False) for one in (nothing, drag)}
    assert errors["linear drag"][1]["position"] < 0.02
    assert errors["nominal"][1]["position"] > 10 * errors["linear drag"][1]["position"]
    assert errors["nominal"][0]["position"] < errors["nominal"][1]["position"]
