"""The draws of benchmarks.draws: the same again, within what is said, and counted rightly."""

from __future__ import annotations

from benchmarks.draws import EACH, OFF, SHEET, drawn, inside, summary


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
    one = {"draw": number, "settings": [], "beliefs": {"force, x": [1.0, 0.5, 1.4, True], "force, y": [1, 9, 0, False]}}
    ends = {"none": none, "auto": auto} | ({"told": told} if told else {})
    return one | {name: {"outcome": "ok" if error else "lost", "error": error} for name, error in ends.items()}


def test_losses_ratios_and_bands_are_counted():
    records = [record(0, 1.0, 0.25), record(1, 1.0, 4.0), record(2, 0.0, 1.0), record(3, 0.0, 0.0, 1.0)]
    records[1]["beliefs"]["force, x"][2] = 2.0  # outside
    assert list(inside(records)) == [("force", 2, 3, 3)]
    lines = summary(records)
    for line in (
        "| lost without | 2 |", "| lost with auto | 1 |", "| lost with auto, not without | 0 |",
        "| lost with auto, perfect_mpc told all flies | 1 |", "| better than without, of 3 | 0.667 |",
        "| ratio to without: geometric mean | 1.000 |", "| force | 0.667 |",
    ):  # fmt: skip
        assert line in lines
