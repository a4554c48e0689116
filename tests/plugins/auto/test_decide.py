"""What acts, and when: a pure function of the posterior and of what is measured beside it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from quadexp.compile.symbolic import ca
from quadexp.control.mpc.settings import MPCSettings
from quadexp.plugins.auto.decide import NOTHING, Decision, Statistics, decided, grids, intervals
from quadexp.plugins.auto.settings import DECISION

GRIDS, NO_SENSES = DECISION.grids, Statistics()


def found(age=0.0, total=0.0, lag=0.0, *, sd=0.0005, age_odds=0.0, total_odds=0.0, at_end=False):
    given = {"mean": [age, total, lag], "deviation": [sd] * 3, "newer": 0.0, "odds": [age_odds, total_odds]}
    return {name: ca.DM(value) for name, value in given.items()} | {"at_end": ca.DM([at_end, False, False, False])}


def decide(of, last=NOTHING, statistics=NO_SENSES):
    """What is decided, as numbers; of: None before there is evidence."""
    known = of is not None
    made = decided(ca.DM(known), of or found(), Decision(*map(ca.DM, last)), Statistics(*map(ca.DM, statistics)), 0.02)
    return Decision(*map(float, made))


def test_delays_act_from_their_bayes_factors_on():
    """An age from very strong evidence on, a dead time and lag from positive evidence on (Kass & Raftery 1995)."""
    for age in (0.005, 0.03):  # a short one looks like how forces go between readings
        needed = DECISION.age_odds * (1 + DECISION.between / age)
        for odds, acted in ((needed - 1, 0.0), (needed + 1, age)):
            assert decide(found(age=age, age_odds=odds), NOTHING, NO_SENSES).age == acted
    for odds, acted in ((DECISION.total_odds - 1, 0.0), (DECISION.total_odds + 1, 0.04)):
        assert decide(found(total=0.04, lag=0.03, total_odds=odds), NOTHING, NO_SENSES).total == pytest.approx(acted)


def test_a_decision_is_a_pure_function_of_what_is_known():
    known, last, statistics = (
        found(age=0.01, total=0.02, lag=0.01, age_odds=20, total_odds=9),
        NOTHING._replace(grid=2),
        NO_SENSES,
    )
    first = decide(known, last, statistics)
    decide(found(age=0.05, age_odds=20), NOTHING, Statistics(busy=1))
    assert decide(known, last, statistics) == first


def test_small_changes_of_what_is_known_change_nothing():
    first = decide(found(total=0.04, lag=0.03, total_odds=9), NOTHING, NO_SENSES)
    assert (first.dead_time, first.lag) == pytest.approx((0.01, 0.03))
    again = decide(found(total=0.0402, lag=0.031, total_odds=9), first, NO_SENSES)
    assert (again.dead_time, again.lag) == (first.dead_time, first.lag)
    assert decide(found(total=0.05, lag=0.031, total_odds=9), again, NO_SENSES).total == pytest.approx(0.05)


def test_an_age_may_be_all_of_what_is_known_as_a_sum():
    """A slow flight, 10 ms late, no dead time: a sum of 10 ms is known, and any share of it is as likely; quantiles
    leave out that it is all age (0.82 of 39 ages, 0 of which was one, lay within)."""
    of = found(age=0.006, total=0.004, age_odds=0.6, total_odds=0.0)
    of |= {"lower": ca.DM([0.0003, 0.0003, 0]), "upper": ca.DM([0.0097, 0.0097, 0])}
    lower, upper = intervals(of, ca.DM.zeros(3))
    assert lower.full()[:2].max() == 0 and upper.full()[:2].ravel() == pytest.approx([0.0105, 0.0105])
    sure = of | {"odds": ca.DM([20.0, 20.0])}
    lower, upper = intervals(sure, ca.DM.zeros(3))
    assert lower.full()[:2].ravel() == pytest.approx([0.0003] * 2)
    assert upper.full()[:2].ravel() == pytest.approx([0.0097] * 2)


def test_the_grid_gets_stiffer_step_by_step_and_softer_at_once():
    decision, levels = NOTHING, []
    for _ in range(4):
        decision = decide(found(), decision, NO_SENSES)
        levels.append(decision.grid)
    assert levels == [1, 2, 3, 3]
    assert decide(found(sd=0.004), decision, NO_SENSES).grid == 2
    assert decide(found(sd=0.008), decision, NO_SENSES).grid == 1
    assert decide(found(), decision, Statistics(busy=1)).grid == 2
    assert decide(found(total=0.03, total_odds=9), decision, NO_SENSES).grid == 2
    assert decide(found(), decision, Statistics(enough=0)).grid == 0


def test_what_may_be_any_later_is_flown_on_the_softest_grid():
    """With what is known acted on: acting on nothing loses the vehicle."""
    late = decide(found(age=0.09, age_odds=50, at_end=True), NOTHING._replace(grid=3), NO_SENSES)
    assert (late.age, late.grid) == (0.09, 0)


def test_long_delays_are_flown_on_the_softest_grid():
    """Of age, dead time, lag and control period together."""
    for total, grid in ((0.06, 1), (0.11, 0)):
        assert decide(found(age=0.02, age_odds=50, total=total, total_odds=9), NOTHING, NO_SENSES).grid == grid


def test_a_disturbance_without_other_evidence_ends_the_softest_grid():
    assert decide(None, NOTHING, NO_SENSES).grid == 0
    assert decide(None, NOTHING, Statistics(acts=True)).grid == 1


def test_no_grid_is_softer_than_what_was_asked_for():
    asked = MPCSettings(rate=50.0, nodes=10, position_weight=(200.0, 1.0, 500.0))
    assert grids(asked)[0] == asked  # the controller's own
    for settings, grid in zip(grids(asked)[1:], GRIDS, strict=True):
        assert settings.position_weight == (200.0, grid.position_weight, 500.0)


def test_a_position_weighs_as_much_beside_the_other_weights_whatever_these_are():
    """A cost twenty times as large has the same optimum; one other weight that is not larger keeps the position's."""
    asked = MPCSettings(rate=100.0, nodes=20, attitude_weight=(0.0, 5.0, 5.0, 200.0), velocity_weight=(1.0,) * 3)
    asked = replace(asked, rate_weight=(1.0,) * 3, input_weight=433.5)
    for settings, grid in zip(grids(asked)[1:], GRIDS, strict=True):
        assert settings.position_weight == pytest.approx((20 * grid.position_weight,) * 3)
    assert grids(asked)[0].position_weight == asked.position_weight  # while nothing is known, as asked
    damped = replace(asked, input_weight=0.03)
    assert [one.position_weight[0] for one in grids(damped)[1:]] == [grid.position_weight for grid in GRIDS]


def test_commands_that_weigh_much_already_weigh_no_more():
    """Sun et al.'s weigh 4,335 times the usual, all else 20 to 50 times: ten times of that left 1.2 to 1.5 times the
    error on their rows."""
    usual = MPCSettings()
    assert max(grid.input_weight for grid in grids(usual)) == max(grid.input_weight for grid in GRIDS)
    heavy = replace(usual, input_weight=4335 * usual.input_weight)
    assert {grid.input_weight for grid in grids(heavy)} == {heavy.input_weight}


def test_grids_fit_any_rate_and_number_of_nodes():
    for rate, nodes in ((50.0, 10), (100.0, 20), (20.0, 5)):
        fitting = grids(MPCSettings(rate=rate, nodes=nodes, input_hold="deviation"))
        assert len(fitting) == 1 + len(GRIDS) and {settings.nodes for settings in fitting} == {nodes}
