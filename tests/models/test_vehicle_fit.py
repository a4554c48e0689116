"""A vehicle model from logged flights with a known truth."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.errors import DataError, UsageError
from quadexp.log.schema import Flight
from quadexp.models.checkpoint import load_model, save_model
from quadexp.models.regression import half_width
from quadexp.models.samples import gather
from quadexp.models.vehicle_model import (
    FitSettings,
    best_level,
    curve_beside_quadratic,
    fit_level,
    fit_vehicle_model,
    left_out,
    selection,
)
from tests.models.logged_flights import CURVE, DRAG, OFFSET, logged_flight, specific_force


@pytest.fixture(scope="module")
def flights():
    return [logged_flight(seed) for seed in range(3)]


@pytest.fixture(scope="module")
def model(flights):
    return fit_vehicle_model(flights)


def within(model, axis, term, truth, times=1.0):
    row = next(r for r in model.records() if (r["axis"], r["term"]) == (axis, term))
    return abs(row["value"] - truth) < times * (row["high"] - row["value"])


def test_linear_drag_and_offsets(model):
    for i, axis in enumerate("xyz"):
        assert within(model.linear, axis, "linear", DRAG[i], 1.5)
    for i, axis in enumerate("xy"):
        assert within(model.linear, axis, "offset", OFFSET[i], 1.5)
    drag = model.linear_drag
    assert drag.drag == pytest.approx(DRAG, abs=0.02) and drag.intercept == pytest.approx(OFFSET, abs=0.02)
    assert model.vehicle == {"name": "known", "fingerprint": "0123456789ab", "mass": None}


def test_the_linear_model_is_least_squares_axis_by_axis(flights, model):
    samples = gather(flights, "motor_command")
    design = np.column_stack([-samples.velocity[:, 0], np.ones(len(samples))])
    wanted = np.linalg.lstsq(design, samples.force[:, 0], rcond=None)[0]
    assert model.linear.coefficients[0] == pytest.approx(wanted, rel=1e-10)


def test_quadratic_drag():
    flights = [logged_flight(seed, quadratic=(0.10, 0.08, 0.06)) for seed in range(4)]
    found = fit_vehicle_model(flights).quadratic
    for axis, truth in zip("xyz", (0.10, 0.08, 0.06), strict=True):
        assert within(found, axis, "quadratic", truth, 1.5)
    for i, axis in enumerate("xy"):
        assert within(found, axis, "linear", DRAG[i], 1.5)


def test_truth_is_inside_at_the_nominal_rate():
    inside, total = 0, 0
    for seed in range(25):
        found = fit_vehicle_model([logged_flight(500 + seed, seconds=15)], settings=FitSettings(kinds=("linear",)))
        inside += sum(within(found.linear, axis, "linear", DRAG[i]) for i, axis in enumerate("xyz"))
        inside += sum(within(found.linear, axis, "offset", OFFSET[i]) for i, axis in enumerate("xy"))
        total += 5
    assert inside / total > 0.89  # 0.95 less three standard deviations of 125 draws


def test_a_checkpoint_is_the_model(flights, model, tmp_path):
    robust = fit_vehicle_model(flights, settings=FitSettings(loss="huber"))
    for i, one in enumerate((model, robust)):
        path = save_model(tmp_path / f"model_{i}", one)
        again = load_model(path)
        for kind in one.models:
            a, b = specific_force(one, flights[0], kind), specific_force(again, flights[0], kind)
            assert np.array_equal(a, b)
        assert str(again) == str(one) and again.best == one.best and again.notes == one.notes
        assert [m.records() for m in again.models.values()] == [m.records() for m in one.models.values()]
    payload = (tmp_path / "model_0" / "model.json").read_text().replace("0.3", "0.4", 1)
    (tmp_path / "model_0" / "model.json").write_text(payload)
    with pytest.raises(DataError, match="damaged or edited"):
        load_model(tmp_path / "model_0")


def test_a_flight_left_out_is_not_seen(flights):
    samples = gather(flights, "motor_command")
    left = left_out("linear", samples, FitSettings())
    others = fit_level("linear", gather(flights[1:], "motor_command"), FitSettings())
    own = samples.rows(samples.flight == 0)
    assert left["flight_0"] == pytest.approx(others.residual(own), abs=1e-12)


def test_the_ladder_ends_at_the_truth():
    flights = [logged_flight(seed, quadratic=(0.10, 0.08, 0.06)) for seed in range(3)]
    rows = selection(gather(flights, "motor_command"), FitSettings())
    norm = {row["level"]: row["held_out"]["norm"] for row in rows}
    assert min(norm["nominal"], norm["offset"]) > 4 * norm["linear"] and norm["linear"] > 1.2 * norm["quadratic"]
    assert norm["quadratic"] == pytest.approx(0.05 * np.sqrt(3), rel=0.1)
    assert best_level(rows) == "quadratic"
    alone = selection(gather(flights[:1], "motor_command"), FitSettings())
    assert all(row["held_out"] is None for row in alone) and best_level(alone) != "nominal"


def test_a_model_that_the_flights_cannot_tell_is_left_out_and_said():
    flight = logged_flight(0)
    steady = {"v_x": 0.7 + 1e-4 * flight["v_x"]} | {f"q_{a}": np.full(len(flight), float(a == "w")) for a in "wxyz"}
    with pytest.raises(DataError, match="linear drag along x: linear_x, offset_x cannot be told apart"):
        fit_vehicle_model([Flight(flight.columns | steady, flight.metadata)])
    level = {"v_z": 0 * flight["v_z"] + 0.3 * np.sign(np.sin(flight.t))} | {
        k: v for k, v in steady.items() if k[0] == "q"
    }
    found = fit_vehicle_model([Flight(flight.columns | level, flight.metadata)])
    assert found.quadratic is None and any(
        note.startswith("no quadratic model: quadratic drag along z") for note in found.notes
    )


def test_flights_of_another_vehicle_are_refused(flights):
    other = Flight(flights[1].columns, flights[1].metadata | {"vehicle": {"name": "other", "fingerprint": "f" * 12}})
    with pytest.raises(DataError, match="flown by vehicle other"):
        fit_vehicle_model([flights[0], other])
    with pytest.raises(UsageError, match="drag 'cubic' is none of linear, quadratic, blade_element"):
        FitSettings(kinds=("cubic",))


def climbing(seed: int) -> Flight:
    """A flight that commands more thrust where it climbs, against 0.12 v_z + 0.4 v_z |v_z| of drag."""
    rng = np.random.default_rng(seed)
    flight = logged_flight(900 + seed, quadratic=(0.0, 0.0, 0.4))
    columns = dict(flight.columns)
    up = flight.air_velocity[:, 2]
    command = 0.7 + 0.03 * up * np.abs(up) + 0.02 * rng.normal(size=len(up))
    ratio = columns["battery_voltage"] / 4
    for i in range(4):
        old, new = columns[f"motor_command_{i}"] * ratio, command * ratio
        columns["acc_z"] = columns["acc_z"] + CURVE[0] * (new - old) + CURVE[1] * (new**2 - old**2)
        columns[f"motor_command_{i}"] = command.copy()
    return Flight(columns, flight.metadata)


def test_the_curve_beside_quadratic_drag_holds_the_truth_where_drag_is_quadratic():
    inside = np.zeros((2, 2))
    for seed in range(12):
        samples = gather([climbing(seed)], "motor_command")
        beside_linear = fit_level("linear", samples, FitSettings()).curve
        beside_quadratic = curve_beside_quadratic(samples, FitSettings(), beside_linear)
        for row, curve in enumerate((beside_linear, beside_quadratic)):
            inside[row] += np.abs(curve.coefficients - CURVE) < half_width(curve.errors, curve.freedom)
    assert np.all(inside[1] >= 9)  # 0.95 of 12 less three standard deviations
    assert np.all(inside[0] <= 6)  # d_z v_z alone leaves quadratic drag to the curve
