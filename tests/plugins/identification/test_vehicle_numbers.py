"""Numbers that a person uses, of flights whose thrust curve, battery and differences are known."""

import numpy as np
import pytest

from quadexp.models.dataset import ResidualDataset
from quadexp.models.drag_choice import chosen_drag
from quadexp.models.linear_drag import DragConfig
from quadexp.models.verdict import split_by_flight, verdict
from quadexp.physics.vehicle import GRAVITY
from quadexp.plugins.identification.identify import identify_vehicle
from quadexp.plugins.identification.recorded import recorded_dataset
from quadexp.plugins.identification.vehicle_model import FitSettings, flight_by_flight
from quadexp.plugins.identification.vehicle_numbers import next_flight, number_lines, numbers_of
from quadexp.plugins.logs.samples import gather
from tests.models.logged_flights import CURVE, logged_flight
from tests.models.recorded_flights import crazyflie, recorded_flight
from tests.slow import slow


def found_of(flights, vehicle=None, **settings):
    names = [f"flight_{i}" for i in range(len(flights))]
    return identify_vehicle(flights, names, vehicle, FitSettings(powers=(1, 2), **settings))


def row_of(numbers, name):
    return next(row for row in numbers["rows"] if row["name"] == name)


HOVER = (-CURVE[0] + np.sqrt(CURVE[0] ** 2 + CURVE[1] * GRAVITY)) / (2 * CURVE[1])  # 4 (c_1 s + c_2 s^2) = g


@pytest.mark.parametrize("first", [0, *slow(10, 20)])
def test_hover_command_and_full_thrust_are_inside(first):
    """Per kg, since the flights' vehicle is not known; at 4 V."""
    numbers = found_of([logged_flight(seed) for seed in range(first, first + 3)]).report["numbers"]
    truths = {"hover command": HOVER, "thrust at full command": sum(CURVE)}
    truths["thrust per signal in hover"] = CURVE[0] + 2 * CURVE[1] * HOVER
    for name, truth in truths.items():
        row = row_of(numbers, name)
        half = row["high"] - row["value"]
        assert abs(row["value"] - truth) < 1.5 * half, row
        assert "kg" in row["unit"] or name == "hover command"
    assert any("thrusts are per kg" in line for line in number_lines(numbers, []))


@pytest.mark.parametrize("exponent", [1.3, *slow(0.7, 1.0)])
def test_the_battery(exponent):
    flights = [logged_flight(seed, exponent=exponent, seconds=60) for seed in range(3)]
    numbers = found_of(flights, voltage_exponent=None).report["numbers"]
    for row in numbers["battery"]:
        scale = (row["voltage"] / 4) ** exponent
        assert row["hover_command"] == pytest.approx(HOVER / scale, rel=0.01)
        assert row["full_thrust"] == pytest.approx(CURVE[0] * scale + CURVE[1] * scale**2, rel=0.03)


def test_newtons_follow_the_mass_that_is_given_and_nothing_else_does():
    vehicle = crazyflie()
    flights = [recorded_flight(seed, vehicle) for seed in range(2)]
    samples = gather(flights, "motor_command")
    model = found_of(flights, vehicle).model
    alone = flight_by_flight(samples, FitSettings(powers=(1, 2)))
    from dataclasses import replace

    heavier = replace(vehicle, mass=1.1 * vehicle.mass)
    one, other = (numbers_of(model.thrust, samples, alone, body, None) for body in (vehicle, heavier))
    for name, factor in (("thrust at full command", 1.1), ("thrust per signal in hover", 1.1), ("hover command", 1.0)):
        assert row_of(other, name)["value"] == pytest.approx(factor * row_of(one, name)["value"])
    text = "\n".join(number_lines(one, model.linear.records()))
    assert "as given by crazyflie" in text and "T the period of the twist" in text and "N per rotor" in text


def test_the_next_value_is_inside_in_95_of_100():
    for count in (3, 5, 12):
        rng, hits = np.random.default_rng(count), []
        for _ in range(2000):
            *seen, ahead = rng.normal(2.0, 0.3, count + 1)
            low, high = next_flight(seen)
            hits.append(low < ahead < high)
        assert np.mean(hits) == pytest.approx(0.95, abs=0.015)
    assert next_flight([1.0]) is None and next_flight([1.0, 1.1]) is None


@pytest.mark.slow
def test_the_next_flight_is_inside():
    """Five flights whose drag and thrust scale differ, and a sixth: 4 groups, 3 numbers each."""
    hits = []
    for group in range(4):
        rng = np.random.default_rng(group)
        drags = 0.4 + 0.05 * rng.standard_normal(6)
        flights = [logged_flight(10 * group + i, drag=np.array([d, d, 0.12])) for i, d in enumerate(drags[:5])]
        numbers = found_of(flights).report["numbers"]
        for axis in "xy":
            low, high = next_flight(row_of(numbers, f"d_{axis}")["each"])
            hits.append(low < drags[5] < high)
            assert high - low > 0.1  # the spread of 0.05, not the fit's error of 0.005
    assert np.mean(hits) >= 0.75


def test_one_flight_says_that_the_next_is_not_known():
    found = found_of([logged_flight(0)])
    lines = number_lines(found.report["numbers"], found.model.linear.records())
    assert any("one flight does not show how flights differ" in line for line in lines)


QUADRATIC = {"none": (0.0, 0.0, 0.0), "some": (0.10, 0.08, 0.06), "more": (0.2, 0.2, 0.1)}


@pytest.mark.parametrize("truth", ["none", "some", *slow("more")])
def test_identify_and_fit_take_the_same_drag(truth):
    vehicle = crazyflie()
    flights = [logged_flight(seed, quadratic=QUADRATIC[truth]) for seed in range(4)]
    for flight in flights:
        flight.metadata["vehicle"] = vehicle.record
    names = [f"flight_{i}" for i in range(4)]
    found = identify_vehicle(flights, names, vehicle)
    rows: ResidualDataset = recorded_dataset(flights, vehicle, found.model.thrust, names=names)
    train, test = split_by_flight(rows, 0.5)
    report = verdict(DragConfig().fit(train), train, test)
    assert found.model.best == chosen_drag(report["air"]) == chosen_drag(found.report["air"])
    assert found.model.best == ("linear" if truth == "none" else "quadratic")
    for one, other in zip(report["air"], found.report["air"], strict=True):
        assert one["rms"] == pytest.approx(other["rms"], rel=0.01)


def test_a_logged_thrust_is_shared_by_the_rotors():
    """The log's acceleration is 5 % too small: in hover it reads g / 1.05."""
    flights = [logged_flight(seed) for seed in range(3)]
    for flight in flights:
        s = flight.stack([f"motor_command_{i}" for i in range(4)]) * (flight["battery_voltage"] / 4)[:, None]
        flight.columns["thrust_acceleration"] = np.sum(CURVE[0] * s + CURVE[1] * s**2, axis=1) / 1.05
    names = [f"flight_{i}" for i in range(3)]
    numbers = identify_vehicle(flights, names, None, FitSettings(signal="thrust_acceleration")).report["numbers"]
    row = row_of(numbers, "thrust_acceleration in hover")
    assert row["value"] == pytest.approx(GRAVITY / 1.05, abs=0.1)
    assert row_of(numbers, "thrust per signal in hover")["value"] == pytest.approx(1.05 / 4, rel=0.03)
