"""False alarms and misses of the check, counted over imitated flights of six vehicles: a table, and limits on it.

pytest tests/plugins/check/test_confusion.py -m slow -s -n 0      prints the table
"""

from collections import Counter
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from quadexp.log.schema import Flight
from quadexp.plugins.check.quality import check_flight
from tests.log.imitated import VEHICLES, imitated, random_mounting, vehicle_named
from tests.plugins.check.faults import changed, inject
from tests.plugins.check.test_mounting import feet, world_frame
from tests.plugins.check.test_rotors import RIGGED, mirrored, reordered
from tests.plugins.logs.importers.test_bad_rows import with_line, with_outliers, with_repeats

FLIGHTS = [(vehicle, seed) for vehicle in (*VEHICLES, "hexa", "octo") for seed in range(200, 206)]


# What is done to a flight, and the blocking findings that it must have; the second half must not block at all.
FAULTS: dict[str, tuple[Callable[[Flight], Flight], set[str]]] = {
    "accelerometer in the world frame": (partial(changed, world_frame), {"frame_acceleration"}),
    "position and velocity in feet": (partial(changed, feet), {"units"}),
    "accelerometer in g": (lambda f: inject(f, "acceleration_in_g"), {"units"}),
    "gyro axes swapped": (lambda f: inject(f, "gyro_axes_swapped"), {"axis_swap"}),
    "all in NED and FRD": (lambda f: inject(f, "ned_everything"), {"ned_not_converted"}),
    "attitude world to body": (lambda f: inject(f, "conjugated"), {"quaternion_conjugate"}),
    "rotors in another order": (
        lambda f: reordered(f, "motor_command", np.roll(np.arange(_rotors(f)), 1)), {"rotor_order"}),
    "spins reversed": (lambda f: f, {"rotor_spin"}),
    "2 s of a straight line": (lambda f: with_line(f, 5.0, 7.0), {"dead_logger"}),
    "2 % of the rows repeated": (lambda f: with_repeats(f, 0.02), {"duplicated_rows"}),
    "2 % outliers": (lambda f: with_outliers(f, 0.02, "acc_y", 120.0), {"acceleration_outlier"}),
}  # fmt: skip


def _rotors(flight: Flight) -> int:
    return sum(name.startswith("motor_command_") for name in flight.columns)


def blocking(flight: Flight, vehicle: str, spins: bool = False) -> set[str]:
    body = vehicle_named(vehicle)
    return {one.name for one in check_flight(flight, mirrored(body) if spins else body) if one.blocks}


@pytest.mark.slow
def test_few_false_alarms_and_few_misses():
    table: dict[str, Counter] = {}
    for number, (vehicle, seed) in enumerate(FLIGHTS):
        options = {"duration": 15.0, "speed": None, **RIGGED}
        sound = imitated(seed, vehicle, **options)
        table.setdefault("sound", Counter())[", ".join(sorted(blocking(sound, vehicle))) or "-"] += 1
        turned = imitated(seed, vehicle, mounting=random_mounting(seed, 3 + 2.4 * (number % 6)), **options)
        found = [one.name for one in check_flight(turned, vehicle_named(vehicle)) if one.name == "mounting"]
        said = blocking(turned, vehicle)
        table.setdefault("turned by 3 to 15 deg", Counter())[", ".join(sorted(said)) or (found or ["-"])[0]] += 1
        if number % 3 == 0:
            noisy = imitated(seed, vehicle, noise=3.0, mounting=random_mounting(seed, 9.0), **options)
            said = blocking(noisy, vehicle)
            table.setdefault("three times the noise, turned", Counter())[", ".join(sorted(said)) or "-"] += 1
        for k in (2 * number, 2 * number + 1):
            name = list(FAULTS)[k % len(FAULTS)]
            fault, expected = FAULTS[name]
            said = blocking(fault(sound), vehicle, spins=name == "spins reversed")
            right = "named" if said == expected else ("and more: " if said > expected else "missed: ")
            right += ", ".join(sorted(said - expected))
            table.setdefault(name, Counter())[right] += 1
    for name, counts in table.items():
        print(f"{name:<36}{dict(counts)}")
    n = len(FLIGHTS)
    assert table["sound"]["-"] == n
    assert table["turned by 3 to 15 deg"]["mounting"] >= n - 1
    assert set(table["three times the noise, turned"]) == {"-"}
    for name in FAULTS:
        assert not any(said.startswith("missed") for said in table[name]), name
