"""Metrics against cases worked by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight
from quadexp.log.store import read_table, write_table
from quadexp.report.metrics import METRICS, attitude_error, flight_metrics, position_error, saturated_share
from quadexp.report.result_rows import ROW_COLUMNS, from_columns, to_columns, to_csv
from quadexp.report.tables import error_table
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


def test_attitude_error_between_two_tilts_is_relative():
    flight = straight_flight(1)
    a, b = math.radians(20) / 2, math.radians(50) / 2  # about the same axis: 30 degrees apart
    flight.columns.update(q_w=np.array([math.cos(a)]), q_y=np.array([math.sin(a)]))
    flight.columns.update(ref_q_w=np.array([math.cos(b)]), ref_q_y=np.array([math.sin(b)]))
    np.testing.assert_allclose(attitude_error(flight), math.radians(30))


def test_a_sample_is_saturated_when_any_rotor_is_at_a_limit():
    flight = straight_flight(4)
    flight.columns["u_1"] = np.array([2.0, 20.0, 19.9, 0.0])
    flight.columns["u_2"] = np.array([2.0, 20.0, 2.0, 2.0])
    assert saturated_share(flight, 0.0, 20.0) == 0.5


def test_solve_times():
    flight = straight_flight(101)
    flight.columns["solve_time"] = np.arange(101) * 1e-6
    metrics = flight_metrics(flight, 0.0, 20.0)
    assert metrics["solve_time_median"] == pytest.approx(50e-6)
    assert metrics["solve_time_p99"] == pytest.approx(99e-6)
    assert metrics["solve_time_max"] == pytest.approx(100e-6)


def test_rows_have_no_count_of_last_resorts_and_tables_of_earlier_versions_are_read(tmp_path):
    made = flight_metrics(straight_flight(5), 0.0, 20.0)
    assert set(made) == set(METRICS) and not any("resort" in name for name in (*made, *ROW_COLUMNS))
    columns = to_columns([row()]) | {"last_resort_count": np.array([3])}
    write_table(tmp_path / "results.parquet", columns, {}, "results")
    (old,) = from_columns(read_table(tmp_path / "results.parquet", "results")[0])
    assert old["last_resort_count"] == 3 and "resort" not in to_csv([old])
    assert error_table([old]).columns == ("nominal_mpc",)


def test_a_flight_that_did_not_happen_has_no_errors_but_every_column():
    metrics = flight_metrics(Flight({}, {}), 0.0, 20.0)
    assert set(metrics) == set(METRICS)
    assert math.isnan(metrics["rmse"]) and metrics["duration"] == 0.0


def test_attitude_error_against_scipy(rng):
    a, b = rng.normal(size=(2, 1000, 4))
    b[:10] = a[:10] * rng.uniform(-3, 3, (10, 1))  # no angle, quaternions of any length and sign
    b[10:20] = a[10:20] + 1e-9 * rng.normal(size=(10, 4))
    expected = (Rotation.from_quat(b, scalar_first=True).inv() * Rotation.from_quat(a, scalar_first=True)).magnitude()
    flight = SimpleNamespace(state=np.pad(a, ((0, 0), (3, 6))), reference_state=np.pad(b, ((0, 0), (3, 6))))
    np.testing.assert_allclose(attitude_error(flight), expected, rtol=0, atol=1e-9)
