"""The rule of the leaderboard on rows whose standing is known."""

import math

import pytest

from quadexp.plugins.bench.ranking import standings
from tests.plugins.bench.rows import board


def of(found):
    return {one.entry: one for one in found}


def test_places_by_mean_rank():
    """a is ahead on the circle, b on the step, by more: ranks do not see by how much, c is last everywhere."""
    rows = board(
        {
            "c": lambda task, seed: 1.0,
            "a": lambda task, seed: 0.1 if task == "circle" else 0.2 + (0.2 if seed == 2 else 0.0),
            "b": lambda task, seed: 0.11 if task == "circle" else 0.3,
        }
    )
    found = standings(rows, baseline="c")
    assert [(one.entry, one.place, one.level) for one in found] == [("a", 1, False), ("b", 2, True), ("c", 3, True)]
    a, b, c = found
    assert a.rank == pytest.approx((1 + 1 + 1.5) / 3) and b.rank == pytest.approx((2 + 2 + 1.5) / 3)
    assert c.rank == 3.0 and math.isnan(c.rank_low)  # last at every seed: no interval
    assert math.isnan(a.rank_low) and a.rank < b.rank  # of three seeds neither


@pytest.mark.parametrize(
    ("seeds", "lost", "order"), [(6, 1, ["good", "poor"]), (6, 6, ["poor", "good"]), (5, 5, ["good", "poor"])]
)
def test_lost_flights_come_first_where_they_tell_apart(seeds, lost, order):
    """`good` loses the step at some seeds: at all six of them p is 2 / 64, five cannot tell."""
    rows = board(
        {"good": lambda task, seed: 0.1 if task != "step" or seed >= lost else None, "poor": lambda task, seed: 0.5},
        seeds=range(seeds),
        tasks=("circle", "square", "step"),
    )
    found = standings(rows, baseline="poor")
    assert [one.entry for one in found] == order and of(found)["good"].lost == lost
    assert found[1].level == (seeds < 6)
    assert of(found)["good"].least_cells == 3 * seeds - lost and of(found)["good"].least == 1.0


def test_ratios():
    """To the least of each cell, and to the baseline, as geometric means over the cells."""
    rows = board(
        {
            "base": lambda task, seed: 0.4,
            "half": lambda task, seed: 0.2 * (1.1 if seed == 1 else 1.0),
            "mixed": lambda task, seed: 0.1 if task == "circle" else 0.8,
        }
    )
    found = of(standings(rows, baseline="base"))
    assert found["half"].ratio.value == pytest.approx(0.5 * 1.1 ** (1 / 3))
    assert found["half"].ratio.low < found["half"].ratio.value < found["half"].ratio.high
    assert found["mixed"].ratio.value == pytest.approx((0.25 * 2.0) ** 0.5)
    assert math.isnan(found["base"].ratio.value)
    least = [0.1, 0.1, 0.1, 0.2, 0.22, 0.2]
    assert found["base"].least == pytest.approx(math.prod(0.4 / x for x in least) ** (1 / 6))


def test_bounds_take_no_rank_and_change_none():
    errors = {"a": lambda task, seed: 0.2, "b": lambda task, seed: 0.3}
    plain = standings(board(errors))
    with_bound = standings([*board(errors), *board({"perfect_mpc": lambda task, seed: 0.1}, bound=1)])
    assert with_bound[:2] == plain
    assert with_bound[2].bound and with_bound[2].least == pytest.approx(0.5) and math.isnan(with_bound[2].rank)


def test_who_lost_everything():
    found = of(standings(board({"a": lambda t, s: 0.1, "b": lambda t, s: None}), baseline="a"))
    assert found["b"].lost == 6 and math.isnan(found["b"].least) and math.isnan(found["b"].ratio.value)
