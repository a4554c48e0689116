"""A vehicle model from logged flights with a known truth, and from recorded ones of which something is published."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from quadexp.errors import DataError
from quadexp.log.schema import Flight
from quadexp.models.checkpoint import load_model, save_model
from quadexp.plugins.identification import comparison
from quadexp.plugins.identification.comparison import (
    best_level,
    chosen_curve,
    compare_curves,
    left_out,
    rmse,
    selection,
)
from quadexp.plugins.identification.identify import identify_vehicle
from quadexp.plugins.identification.lines import identification_lines
from quadexp.plugins.identification.vehicle_model import FitSettings, fit_level, fit_vehicle_model, flight_by_flight
from quadexp.plugins.logs.samples import gather
from tests.log.imitated import vehicle_named
from tests.models.logged_flights import CURVE, DRAG, OFFSET, logged_flight, specific_force
from tests.models.recorded_data import blackbird, nanobench


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
    assert drag.feature_range == model.feature_range != {}  # so that a flight with it says whether it left its data


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


def test_a_checkpoint_is_the_model(flights, model, tmp_path):
    path = save_model(tmp_path / "model", model)
    again = load_model(path)
    for kind in model.models:
        assert np.array_equal(*(specific_force(one, flights[0], kind) for one in (model, again)))
    assert str(again) == str(model) and again.best == model.best and again.notes == model.notes
    assert [m.records() for m in again.models.values()] == [m.records() for m in model.models.values()]
    payload = (path / "model.json").read_text().replace("0.3", "0.4", 1)
    (path / "model.json").write_text(payload)
    with pytest.raises(DataError, match="damaged or edited"):
        load_model(path)


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
    with pytest.raises(DataError, match="linear drag along x: linear_x, offset_x cannot be distinguished"):
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


def on_another_battery(flight: Flight, lower: float, exponent: float) -> Flight:
    """The same flight and commands with a voltage lower by so much (V), and the thrust that it then has."""
    columns = dict(flight.columns)
    voltage = columns["battery_voltage"]

    def thrust(at: np.ndarray) -> np.ndarray:
        scaled = [columns[f"motor_command_{i}"] * (at / 4) ** exponent for i in range(4)]
        return sum(CURVE[0] * s + CURVE[1] * s**2 for s in scaled)

    columns["acc_z"] = columns["acc_z"] + thrust(voltage - lower) - thrust(voltage)
    return Flight(columns | {"battery_voltage": voltage - lower}, flight.metadata)


def two_batteries(exponent: float) -> list[Flight]:
    flights = [logged_flight(seed, exponent=exponent) for seed in (20, 21, 22)]
    return [on_another_battery(one, lower, exponent) for one, lower in zip(flights, (0.0, 0.5, 0.9), strict=True)]


def chosen(flights: list[Flight]) -> FitSettings:
    return chosen_curve(comparison.compare_curves(gather(flights, "motor_command"), FitSettings()), FitSettings())


def test_two_flights_on_two_batteries_tell_the_voltage_exponent():
    *seen, unseen = two_batteries(0.7)
    settings = chosen(seen)
    assert settings.voltage_exponent is None and settings.powers == (1, 2)
    model = fit_vehicle_model(seen, settings=settings)
    usual = fit_vehicle_model(seen)
    force = unseen["acc_z"]
    error, usual_error = (np.std(force - specific_force(one, unseen, "linear")[:, 2]) for one in (model, usual))
    assert model.thrust.voltage_exponent == pytest.approx(0.7, abs=0.03)
    assert error == pytest.approx(0.05, rel=0.2) and usual_error > 2 * error


@pytest.mark.parametrize(
    ("exponent", "count", "fitted"), [(0.7, 3, True), (0.7, 1, False), (1.0, 2, False), (1.0, 3, False)]
)
def test_the_usual_curve_stays_where_it_is_the_truth_or_one_flight_flew(exponent, count, fitted):
    settings = chosen(two_batteries(exponent)[:count])
    assert settings.voltage_exponent is None if fitted else settings == FitSettings()


def test_an_exponent_that_no_motor_has_is_not_used():
    """The second flight has a third more thrust at nearly the same voltage: new propellers, not the battery."""
    flights = [logged_flight(seed) for seed in (30, 31)]
    columns = dict(on_another_battery(flights[1], 0.1, 1.0).columns)
    columns["acc_z"] = 1.3 * columns["acc_z"]
    rows = comparison.compare_curves(
        gather([flights[0], Flight(columns, flights[1].metadata)], "motor_command"), FitSettings()
    )
    fitted = {tuple(row["powers"]): row["exponent"] for row in rows if row["voltage"] == "V^g"}
    assert all(not 0.5 <= g <= 1.5 for g in fitted.values())
    assert chosen_curve(rows, FitSettings()).voltage_exponent == 1.0


def test_a_thinned_ladder_says_the_same(monkeypatch):
    samples = gather([logged_flight(seed) for seed in range(3)], "motor_command")
    every = comparison.selection(samples, FitSettings())
    monkeypatch.setattr(comparison, "MOST_SAMPLES", 1500)
    some = comparison.selection(samples, FitSettings())
    for a, b in zip(every, some, strict=True):
        assert b["held_out"]["norm"] == pytest.approx(a["held_out"]["norm"], rel=0.05)
    assert comparison.best_level(some) == comparison.best_level(every)


@cache
def identified_of_drag(radius):
    """The vehicle of three flights with linear drag, by a radius of its rotors or without one."""
    vehicle = replace(vehicle_named("crazyflie"), mass=0.03)
    flown = [logged_flight(seed, seconds=12) for seed in range(3)]
    flights = [Flight(flight.columns, {**flight.metadata, "vehicle": vehicle.record}) for flight in flown]
    return identify_vehicle(flights, ["a", "b", "c"], vehicle, FitSettings(radius=radius))


@pytest.mark.parametrize(("radius", "winner"), [(0.02, "blade_element"), (0.3, comparison.HOVER_INFLOW)])
def test_knowing_the_radius_keeps_the_row_without_it_and_takes_the_better(radius, winner):
    """Linear drag is the truth: which radius helps on flights left out is chance, and the ladder shows both rows."""
    without, found = identified_of_drag(None), identified_of_drag(radius)
    rows = {row["level"]: row for row in found.report["selection"]}
    alone = {row["level"]: row for row in without.report["selection"]}
    assert comparison.HOVER_INFLOW in rows and comparison.HOVER_INFLOW not in alone
    assert rows[comparison.HOVER_INFLOW]["held_out"] == alone["blade_element"]["held_out"]
    scores = {level: rows[level]["held_out"]["norm"] for level in ("blade_element", comparison.HOVER_INFLOW)}
    assert min(scores, key=scores.__getitem__) == winner
    assert isinstance(found.model.blade_element.momentum, tuple) == (winner == "blade_element")
    noted = any("its error on held-out flights is smaller" in note for note in found.model.notes)
    assert noted == (winner == comparison.HOVER_INFLOW)
    lines = identification_lines(found.model, found.report)
    assert any(line.startswith("blade element, no V_I") for line in lines)
    assert any(line.startswith("blade element, with V_I") for line in lines)
    assert sum("<- best" in line for line in lines) == 1


@pytest.mark.slow
def test_a_quarter_of_an_hour_at_400_hz():
    """360 000 rows in ten flights: the truth within its intervals."""
    flights = []
    for seed in range(10):
        parts = [logged_flight(100 * seed + j, seconds=60) for j in range(6)]
        columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns}
        columns["t"] = np.arange(len(columns["t"])) / 400
        flights.append(Flight(columns, {**parts[0].metadata, "name": f"flight_{seed}"}))
    found = identify_vehicle(flights, [f"flight_{seed}" for seed in range(10)])
    for i, axis in enumerate("xyz"):
        value, error = found.model.linear.coefficient(axis, "linear")
        assert abs(value - DRAG[i]) < 4 * error < 0.02
    assert found.model.best in ("linear", "quadratic")


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
