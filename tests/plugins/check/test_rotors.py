"""A wrong order of the rotors, or spin, contradicts the angular acceleration; a right one is left alone."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from quadexp.log.schema import Flight
from quadexp.plugins.check.quality import check_flight, check_flights
from quadexp.plugins.check.rotors import judge, motion_of
from quadexp.plugins.check.signals import check_voltage
from tests.log.imitated import VEHICLES, imitated, vehicle_named
from tests.models.recorded_data import nanobench

RIGGED = {"gain": (0.6, 0.5, 0.4), "lag": 0.02, "offset": (1.0, -0.5, 0.2)}  # as real vehicles are


def reordered(flight: Flight, kind: str, order) -> Flight:
    """The flight with the rotors' columns in another order: column i is rotor order[i]."""
    return Flight(
        {**flight.columns, **{f"{kind}_{i}": flight[f"{kind}_{k}"] for i, k in enumerate(order)}}, flight.metadata
    )


def mirrored(vehicle):
    return replace(vehicle, rotor_spin=tuple(-s for s in vehicle.rotor_spin))


@pytest.mark.parametrize(
    ("signal", "vehicle"),
    [
        pytest.param(signal, name, marks=[pytest.mark.slow] * (signal != "motor_command" and name != "torrente"))
        for signal in ("motor_command", "rotor_speed", "u")
        for name in (*VEHICLES, "hexa", "octo")
    ],
)
def test_every_order_is_told(vehicle, signal):
    body = vehicle_named(vehicle)
    flight = imitated(70, vehicle, signal=signal, duration=15, **RIGGED)
    n = body.n_rotors
    rng = np.random.default_rng(0)
    orders = list(permutations(range(n))) if n == 4 else [tuple(rng.permutation(n)) for _ in range(6)]
    for order in orders:
        verdict = judge([motion_of(reordered(flight, signal, order), body)], body)
        assert verdict.order == tuple(np.argsort(order)) and verdict.spin == 1
        assert verdict.wrong_order == (tuple(order) != tuple(range(n)))


@pytest.mark.parametrize("vehicle", [*VEHICLES, "hexa"])
def test_a_reversed_spin_is_told(vehicle):
    flight = imitated(71, vehicle, **RIGGED)
    body = vehicle_named(vehicle)
    assert judge([motion_of(flight, body)], body).spin == 1
    found = [one for one in check_flight(flight, mirrored(body)) if one.blocks]
    assert [one.name for one in found] == ["rotor_spin"] and "rotor_spin" in found[0].advice


def test_check_names_the_order_that_mends_it():
    flight = imitated(72, "torrente", **RIGGED)
    wrong = reordered(flight, "motor_command", (2, 0, 1, 3))
    (found,) = [one for one in check_flight(wrong, vehicle_named("torrente")) if one.blocks]
    assert found.name == "rotor_order" and "order 1, 2, 0, 3" in found.advice
    mended = reordered(wrong, "motor_command", (1, 2, 0, 3))
    assert all((mended[f"motor_command_{i}"] == flight[f"motor_command_{i}"]).all() for i in range(4))
    assert not [one.message for one in check_flight(wrong) if one.blocks]  # nobody says which vehicle it was


def test_flights_too_short_by_themselves_tell_together():
    """Three flights of five seconds with a gyro that shakes: none is clear, all of them are."""
    flights = {str(seed): imitated(seed, "torrente", duration=4.5, noise=1.0) for seed in (73, 74, 75)}
    wrong = {name: reordered(flight, "motor_command", (1, 0, 3, 2)) for name, flight in flights.items()}
    body = vehicle_named("torrente")
    for given, said in ((flights, False), (wrong, True)):
        found = check_flights(given, body)
        assert all(("rotor_order" in {one.name for one in findings}) == said for findings in found.values())


def test_a_hover_says_nothing_of_its_rotors():
    flight = imitated(76, "torrente", speed=0.02, busy=0.01, noise=2.0)
    wrong = reordered(flight, "motor_command", (2, 0, 1, 3))
    assert not {"rotor_order", "rotor_spin"} & {one.name for one in check_flight(wrong, vehicle_named("torrente"))}


@pytest.mark.parametrize("name", ["B2_circle_fast_rep2", "B9_trefoil_fast_rep14", "B3_figure8_fast_rep1"])
def test_on_real_flights(name):
    """All 24 orders of a Crazyflie's motors, each from one flight alone; and its spin."""
    body = vehicle_named("crazyflie")
    motion = motion_of(nanobench(name), body)
    for order in permutations(range(4)):
        verdict = judge([replace(motion, thrust=motion.thrust[:, :, list(order)])], body)
        assert verdict.order == tuple(np.argsort(order)) and verdict.clear and verdict.spin == 1
        assert verdict.wrong_order == (order != (0, 1, 2, 3))
    assert judge([motion], mirrored(body)).spin == -1


@pytest.mark.parametrize(
    ("vehicle", "voltage", "named"),
    [("torrente", 15.2, False), ("torrente", 1.52, True), ("torrente", 3.8, True), ("crazyflie", 3.8, False),
     ("crazyflie", 380.0, True), ("crazyflie", 0.0, True)],
)  # fmt: skip
def test_a_voltage_that_no_battery_has(vehicle, voltage, named):
    flight = imitated(77, vehicle, duration=2.0)
    columns = flight.columns | {"battery_voltage": np.full(len(flight), voltage)}
    found = check_voltage(Flight(columns, flight.metadata), vehicle_named(vehicle))
    assert bool(found) == named and (not found or found[0].blocks == (voltage > 0))
