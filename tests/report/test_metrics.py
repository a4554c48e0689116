"""Metrics against cases worked by hand."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.log.outcome import COMPLETED
from quadexp.log.schema import Flight
from quadexp.log.store import write_table
from quadexp.report.metrics import (
    ERRORS,
    METRICS,
    attitude_error,
    charge_used,
    command_change,
    flight_metrics,
    position_error,
    saturated_share,
    to_columns,
)
from quadexp.report.summary import flight_lines
from quadexp.report.text import shown
from quadexp.sweeps.results import select
from quadexp.sweeps.sweep_table import table_row
from tests.log.flights import straight_flight
from tests.report.test_tables import row


def test_a_constant_offset_is_every_error_at_once():
    flight = straight_flight(offset=(0.03, 0.0, 0.04))  # 3-4-5: 50 mm
    metrics = flight_metrics(flight, 0.0, 20.0)
    for name in ("rmse", "mean_error", "max_error"):
        assert metrics[name] == pytest.approx(0.05, rel=1e-12)
    assert metrics["attitude_rmse"] == pytest.approx(0.0, abs=1e-9)
    assert metrics["peak_speed"] == 2.0 and metrics["duration"] == pytest.approx(0.08)


def test_rmse_and_mean_error_are_two_things():
    flight = straight_flight(4)
    flight.columns["ref_p_y"] = flight["p_y"] + [0.0, 0.0, 0.0, 0.4]
    metrics = flight_metrics(flight, 0.0, 20.0)
    assert metrics["mean_error"] == pytest.approx(0.1)  # 0.4 / 4
    assert metrics["rmse"] == pytest.approx(0.2)  # sqrt(0.16 / 4)
    assert metrics["max_error"] == pytest.approx(0.4)
    np.testing.assert_allclose(position_error(flight), [0, 0, 0, 0.4])


def test_attitude_error_is_the_rotation_angle_and_blind_to_the_quaternions_sign():
    flight = straight_flight(3)
    half = math.radians(30) / 2  # a rotation of 30 degrees about x
    flight.columns["q_w"] = np.array([1.0, math.cos(half), -math.cos(half)])
    flight.columns["q_x"] = np.array([0.0, math.sin(half), -math.sin(half)])
    np.testing.assert_allclose(attitude_error(flight), [0.0, math.radians(30), math.radians(30)], atol=1e-12)
    expected = math.sqrt(2 / 3) * math.radians(30)
    assert flight_metrics(flight, 0.0, 20.0)["attitude_rmse"] == pytest.approx(expected)


def test_a_sample_is_saturated_when_any_rotor_is_at_a_limit():
    flight = straight_flight(4)
    flight.columns["u_1"] = np.array([2.0, 20.0, 19.9, 0.0])
    flight.columns["u_2"] = np.array([2.0, 20.0, 2.0, 2.0])
    assert saturated_share(flight, 0.0, 20.0) == 0.5


@pytest.mark.parametrize("every", [1, 6])
def test_instants_of_an_inner_loop_are_no_steps_of_the_controller(every):
    """Samples at 0.01 s; the controller steps at every n-th, and its record stands beside the instants between."""
    flight = straight_flight(60)
    flight.columns["solve_time"] = np.where(np.arange(60) % every == 0, 50e-6, 4e-6)
    flight.columns["unconverged"] = (np.arange(60) < every).astype(np.int8)
    dt = flight.t[1] - flight.t[0]
    metrics = flight_metrics(flight, 0.0, 20.0, every * dt)
    assert metrics["solve_time_median"] == pytest.approx(50e-6) and metrics["unconverged_count"] == 1
    flight.columns["solve_time"] = np.arange(60) * 1e-6
    metrics = flight_metrics(flight, 0.0, 20.0)
    names = ("solve_time_median", "solve_time_p99", "solve_time_max")
    assert [1e6 * metrics[name] for name in names] == pytest.approx([29.5, 58.41, 59])


@pytest.mark.parametrize("outcome", ["lost", "solver_failed", "left_corridor", "ok"])
def test_a_flight_that_was_not_flown_to_its_end_has_no_error(tmp_path, outcome):
    """Nor has one in a table of an earlier version, which wrote the error up to there; it is sorted last."""
    flight = straight_flight(5, (0.03, 0.0, 0.0))
    flight.metadata["outcome"] = outcome
    metrics, ended = flight_metrics(flight, 0.0, 20.0), outcome in COMPLETED
    errors = ("rmse", "mean_error", "max_error", "attitude_rmse", "heading_rmse")
    assert [math.isnan(metrics[name]) for name in errors] == [not ended] * 5
    assert metrics["duration"] > 0 and metrics["peak_speed"] > 0
    old = [{**row(), "outcome": outcome, "mean_error": 1e-9, "key": "a"}, {**row(), "mean_error": 1.0, "key": "b"}]
    (tmp_path / "cells").mkdir()
    write_table(tmp_path / "results.parquet", to_columns(old), {}, "results")
    assert [one["key"] for one in select(tmp_path, sort="mean_error").rows] == (["a", "b"] if ended else ["b", "a"])
    assert table_row(old[0])["mean_error"] == pytest.approx(1e-9 if ended else math.nan, nan_ok=True)


def test_every_error_is_shown_with_its_unit():
    assert [shown(name)[1] for name in ERRORS] == ["mm", "mm", "mm", "°", "°"]


def test_a_flight_that_did_not_happen_has_no_errors_but_every_column():
    metrics = flight_metrics(Flight({}, {}), 0.0, 20.0)
    assert set(metrics) == set(METRICS)
    assert math.isnan(metrics["rmse"]) and metrics["duration"] == 0.0


def test_attitude_error_against_scipy(rng):
    a, b = rng.normal(size=(2, 1000, 4))
    b[:10] = a[:10] * rng.uniform(-3, 3, (10, 1))  # no angle, quaternions of any length and sign
    b[10:20] = a[10:20] + 1e-9 * rng.normal(size=(10, 4))
    expected = (Rotation.from_quat(b, scalar_first=True).inv() * Rotation.from_quat(a, scalar_first=True)).magnitude()
    columns = dict(zip(("q_w", "q_x", "q_y", "q_z"), a.T, strict=True))
    flight = Flight(columns | dict(zip((f"ref_{name}" for name in columns), b.T, strict=True)), {})
    np.testing.assert_allclose(attitude_error(flight), expected, rtol=0, atol=1e-9)


def test_a_free_heading_is_in_no_error(rng):
    """The angle between thrust axes, by SciPy, whatever the vehicle turned about its own."""
    tilt, turn = rng.uniform(0.1, 3.0, 5), rng.uniform(-3, 3, 5)
    flown = Rotation.from_rotvec(np.outer(tilt, [0.6, 0.8, 0.0])) * Rotation.from_rotvec(np.outer(turn, [0, 0, 1.0]))
    reference = Rotation.random(random_state=1)
    flight = straight_flight(5)
    for prefix, rotation in (("", reference * flown), ("ref_", Rotation.concatenate([reference] * 5))):
        columns = rotation.as_quat(scalar_first=True).T
        flight.columns.update({f"{prefix}q_{i}": column for i, column in zip("wxyz", columns, strict=True)})
    assert attitude_error(flight) == pytest.approx((reference.inv() * reference * flown).magnitude())
    assert not np.allclose(attitude_error(flight), tilt, atol=0.05)
    flight.metadata["free_heading"] = True
    assert attitude_error(flight) == pytest.approx(tilt)
    assert flight_metrics(flight, 0.0, 20.0)["heading_rmse"] is None


def test_change_of_a_command_and_charge_used():
    """Two rotors of four swing by 1 N of a range of 20 N from step to step: sqrt(1 / 2) / 20."""
    t = np.arange(6) * 0.01
    swing = np.where(np.arange(6) % 2, 6.0, 5.0)
    columns = {"t": t, "u_0": swing, "u_1": swing, "u_2": 0 * t + 5, "u_3": 0 * t + 5}
    flight = Flight(columns | {"state_of_charge": 1 - 0.02 * np.arange(6)}, {})
    assert command_change(flight, 0.0, 20.0) == pytest.approx(math.sqrt(0.5) / 20)
    assert command_change(flight, 0.0, 20.0, every=2) == 0  # of a controller that steps at every other sample
    assert charge_used(flight) == pytest.approx(0.1) and charge_used(Flight(columns, {})) is None


def test_the_step_of_a_law_is_no_time_of_zero():
    """A tenth of a microsecond is said as that."""
    about = {
        "controller": "pid",
        "trajectory": "hover",
        "plant": "ideal",
        "seed": 0,
        "speed": math.nan,
        "outcome": "ok",
    }
    times = {"solve_time_median": 0.11e-6, "solve_time_p99": 14.2e-6, "solve_time_max": 8064e-6, "backend": "compiled"}
    errors = {"mean_error": 0.1, "rmse": 0.1, "max_error": 0.1, "attitude_rmse": 0.1}
    flown = {"duration": 1.0, "peak_speed": 0.0, "saturated_share": 0.0}
    lines = flight_lines({"row": {"speed": math.nan} | about | times | errors | flown})
    assert "step        median 0.110 us, 99 % 14.2 us, largest 8064 us (compiled)" in lines
