"""Which thrust curve and which model flights left out speak for, and what it costs on many rows."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.experiment.identify import chosen_curve, identify_vehicle
from quadexp.log.schema import Flight
from quadexp.models import selection as ladder
from quadexp.models.samples import gather
from quadexp.models.vehicle_model import FitSettings, fit_vehicle_model
from quadexp.report.model_lines import identification_lines
from tests.models.logged_flights import CURVE, DRAG, logged_flight, specific_force


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
    return chosen_curve(ladder.compare_curves(gather(flights, "motor_command"), FitSettings()), FitSettings())


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


def test_three_flights_tell_it_too_and_one_does_not():
    flights = two_batteries(0.7)
    assert chosen(flights).voltage_exponent is None
    assert chosen(flights[:1]) == FitSettings()


def test_the_usual_curve_stays_where_it_is_the_truth():
    assert chosen(two_batteries(1.0)[:2]) == FitSettings()
    assert chosen(two_batteries(1.0)) == FitSettings()


def test_an_exponent_that_no_motor_has_is_not_used():
    """The second flight has a third more thrust at nearly the same voltage: new propellers, not the battery."""
    flights = [logged_flight(seed) for seed in (30, 31)]
    columns = dict(on_another_battery(flights[1], 0.1, 1.0).columns)
    columns["acc_z"] = 1.3 * columns["acc_z"]
    rows = ladder.compare_curves(
        gather([flights[0], Flight(columns, flights[1].metadata)], "motor_command"), FitSettings()
    )
    fitted = {tuple(row["powers"]): row["exponent"] for row in rows if row["voltage"] == "V^g"}
    assert all(not 0.5 <= g <= 1.5 for g in fitted.values())
    assert chosen_curve(rows, FitSettings()).voltage_exponent == 1.0


def test_a_thinned_ladder_says_the_same(monkeypatch):
    samples = gather([logged_flight(seed) for seed in range(3)], "motor_command")
    every = ladder.selection(samples, FitSettings())
    monkeypatch.setattr(ladder, "MOST_SAMPLES", 1500)
    some = ladder.selection(samples, FitSettings())
    for a, b in zip(every, some, strict=True):
        assert b["held_out"]["norm"] == pytest.approx(a["held_out"]["norm"], rel=0.05)
    assert ladder.best_level(some) == ladder.best_level(every)


@pytest.mark.parametrize(("radius", "winner"), [(0.02, "blade_element"), (0.3, ladder.HOVER_INFLOW)])
def test_knowing_the_radius_keeps_the_row_without_it_and_takes_the_better(radius, winner):
    """Linear drag is the truth: which radius helps on flights left out is chance, and the ladder shows both rows."""
    flights, names = [logged_flight(seed, seconds=12) for seed in range(3)], ["a", "b", "c"]
    without = identify_vehicle(flights, names, settings=FitSettings(mass=0.03))
    found = identify_vehicle(flights, names, settings=FitSettings(mass=0.03, radius=radius))
    rows = {row["level"]: row for row in found.report["selection"]}
    alone = {row["level"]: row for row in without.report["selection"]}
    assert ladder.HOVER_INFLOW in rows and ladder.HOVER_INFLOW not in alone
    assert rows[ladder.HOVER_INFLOW]["held_out"] == alone["blade_element"]["held_out"]
    scores = {level: rows[level]["held_out"]["norm"] for level in ("blade_element", ladder.HOVER_INFLOW)}
    assert min(scores, key=scores.__getitem__) == winner
    assert isinstance(found.model.blade_element.momentum, tuple) == (winner == "blade_element")
    noted = any("its error on held-out flights is smaller" in note for note in found.model.notes)
    assert noted == (winner == ladder.HOVER_INFLOW)
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
