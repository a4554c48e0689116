"""What is published or known of the recorded flights beside the repository."""

from __future__ import annotations

import pytest

from quadexp.models.samples import gather
from quadexp.models.vehicle_model import (
    FitSettings,
    best_level,
    compare_curves,
    fit_level,
    flight_by_flight,
    rmse,
    selection,
)
from tests.models.recorded_data import blackbird, nanobench

NANOBENCH = {
    "B2_circle_fast_rep2": (0.388, 0.418),
    "B9_trefoil_fast_rep14": (0.414, 0.393),
    "B3_figure8_fast_rep1": (0.405, 0.406),
}


@pytest.fixture(scope="module")
def crazyflie():
    return gather([nanobench(name) for name in NANOBENCH], "motor_command", list(NANOBENCH))


def test_nanobench_linear_drag_flight_by_flight(crazyflie):
    for one in flight_by_flight(crazyflie, FitSettings()):
        found = {row["axis"]: row for row in one["coefficients"] if row["term"] == "linear"}
        for axis, wanted in zip("xy", NANOBENCH[one["flight"]], strict=True):
            assert found[axis]["value"] == pytest.approx(wanted, rel=0.02)
            assert found[axis]["low"] < wanted < found[axis]["high"]


def test_nanobench_on_the_flight_not_seen(crazyflie):
    unseen = crazyflie.flight == 2
    train, test = crazyflie.rows(~unseen), crazyflie.rows(unseen)
    nominal, linear = (rmse(fit_level(k, train, FitSettings()).residual(test)) for k in ("nominal", "linear"))
    assert linear["x"] < 0.2 * nominal["x"] and linear["y"] < 0.2 * nominal["y"]
    # along z the thrust for a command differs by some per cent from day to day, which no drag makes up for
    assert linear["norm"] < 0.75 * nominal["norm"]


def test_flights_left_out_speak_for_the_plainest_thrust_curve(crazyflie):
    rows = {(tuple(c["powers"]), c["voltage"]): c["held_out"] for c in compare_curves(crazyflie, FitSettings())}
    assert min(rows, key=rows.get) == ((1,), "V")
    assert rows[(1, 2), "unused"] > 1.5 * rows[(1, 2), "V"]  # the battery's voltage matters


def test_blackbird():
    samples = gather([blackbird("train"), blackbird("test")], "thrust_acceleration", ["train", "test"])
    found = {row["level"]: row for row in selection(samples, FitSettings())}
    assert found["offset"]["held_out"]["norm"] == pytest.approx(0.727, rel=0.03)
    assert found["linear"]["held_out"]["norm"] == pytest.approx(0.323, rel=0.03)
    assert best_level(list(found.values())) == "blade_element"
    assert found["blade_element"]["held_out"]["norm"] < 0.95 * found["linear"]["held_out"]["norm"]
