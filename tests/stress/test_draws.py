"""The draws of benchmarks.draws: the same again, within what is said, and counted rightly."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.draws import EACH, EXAMPLES, OFF, SHEET, drawn, inside, summary
from benchmarks.wider_draws import LARGEST_LAG, LATEST, LENGTHS, MISSING, drawn_wider, missing_readings
from quadexp.control.base import Measurement
from quadexp.control.readings import ReadingGate
from quadexp.parts.compose import compose


def settings(seed, number):
    common, untold, _ = drawn(seed, number)
    return dict(text.split("=", 1) for text in [*common, *untold])


def test_draws_are_the_same_again_and_within_what_is_said():
    first, again, other = settings(5, 0), settings(5, 0), settings(6, 0)
    assert first == again != other
    for number in range(EACH):
        one = settings(5, number)
        assert one["vehicle"] == first["vehicle"] and one["truth.mass"] == first["truth.mass"]  # the same vehicle
        assert 1 / SHEET - 1e-3 <= float(one.get("sensor.sheet_factor", 1)) <= SHEET
        assert OFF[0] <= float(one["truth.mass"]) <= OFF[1]
    assert len({settings(5, number)["seed"] for number in range(EACH)}) == EACH


def record(number, none, auto, told=None):
    one = {
        "draw": number,
        "settings": [],
        "beliefs": {"force, x": [0.5, 1.5, 1.4, True], "force, y": [-8, 10, 0, False]},
    }
    ends = {"none": none, "auto": auto} | ({"told": told} if told else {})
    return one | {name: {"outcome": "ok" if error else "lost", "error": error} for name, error in ends.items()}


def test_losses_ratios_and_bands_are_counted():
    records = [record(0, 1.0, 0.25), record(1, 1.0, 4.0), record(2, 0.0, 1.0), record(3, 0.0, 0.0, 1.0)]
    records[1]["beliefs"]["force, x"][2] = 2.0  # outside
    assert list(inside(records)) == [("force", 2, 3, 3)]
    lines = summary(records)
    for line in (
        "| lost without | 2 |", "| lost with auto | 1 |", "| lost with auto, not without | 0 |",
        "| lost with auto, perfect_mpc given all flies | 1 |", "| better than without, of 3 | 0.667 |",
        "| ratio to without: geometric mean | 1.000 |", "| force | 0.667 |",
    ):  # fmt: skip
        assert line in lines


def test_wider_draws_are_the_same_again_can_be_flown_and_reach_further():
    assert drawn_wider(5, 0) == drawn_wider(5, 0) != drawn_wider(6, 0)
    words, shares = [], []
    for number in range(30):
        common, untold, told, missing = drawn_wider(5, number)
        compose([*common, *untold], EXAMPLES), compose([*common, *told], EXAMPLES)
        words.append(dict(text.split("=", 1) for text in [*common, *untold]))
        shares.append(missing)

    def of(key):
        return np.array([float(each[key]) for each in words if key in each])

    assert min(shares) == 0.0 < max(shares) <= MISSING
    assert LENGTHS[0] <= of("trajectory.duration").min() and LENGTHS[1] >= of("trajectory.duration").max() > 40
    delays = np.concatenate([of("estimator.delay"), of("link.latency")])
    assert delays.min() >= 0 and 0.04 < delays.max() <= LATEST and of("actuator.time_constant_up").max() <= LARGEST_LAG
    assert of("controller.rate").min() < 50 < 200 < of("controller.rate").max()
    assert of("vehicle.mass").min() < 0.5 and of("vehicle.mass").max() > 3
    assert {"hover", "rectangle", "file"} <= {each["trajectory"] for each in words}


def test_missing_readings_are_missing_only_meanwhile():
    gate, measurement = ReadingGate(4), Measurement(0.0, np.eye(13)[3], np.ones(3), None)
    with missing_readings(0.2):
        lost = [gate.admit(measurement).specific_force is None for _ in range(500)]
    assert np.mean(lost) == pytest.approx(0.2, abs=0.06)
    assert gate.admit(measurement).specific_force is not None
