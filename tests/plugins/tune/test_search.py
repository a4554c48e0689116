"""A search finds what is known to be best, is the same again, and goes on where it was interrupted."""

import pytest

from quadexp.errors import UsageError
from quadexp.experiment.evaluate import evaluate_cell
from quadexp.plugins.tune.call import tune
from quadexp.plugins.tune.search import best_of
from quadexp.plugins.tune.settings import Tune
from quadexp.sweeps.sweep import SweepInterrupted
from tests.plugins.tune.parts import BEST, HOVER, WeightCell, open_loop, same, search

BOTH = ("controller.position_weight=1..1000:log", "controller.nodes=5..20")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A search of fourteen trials: ten at random, four by what was learned."""
    out = tmp_path_factory.mktemp("whole") / "t"
    return out, search(out, 14, WeightCell(), BOTH)


def test_the_first_trial_is_the_option_as_it_is(whole):
    assert whole[1][0].numbers == (10.0, 10)


def test_it_finds_the_best_weight(tmp_path):
    trials = search(tmp_path / "t", 30, WeightCell())
    assert trials[best_of(trials)].numbers[0] == pytest.approx(BEST, rel=0.1)


def test_weights_that_lose_the_vehicle_are_left(tmp_path):
    trials = search(tmp_path / "t", 30, WeightCell(lost=20.0))
    best = trials[best_of(trials)]
    assert 15 < best.numbers[0] <= 20 and best.worth.lost == 0
    assert sum(trial.worth.lost for trial in trials[15:]) < 10


def test_the_same_again(whole, tmp_path):
    assert same(whole[1], search(tmp_path / "t", 14, WeightCell(), BOTH))
    assert not same(whole[1], search(tmp_path / "u", 14, WeightCell(), BOTH, seed=1))


@pytest.mark.parametrize("stop", [0, 3, 12])
def test_an_interrupted_search_goes_on_as_if_it_never_had_been(whole, tmp_path, stop):
    with pytest.raises(SweepInterrupted, match=f"{stop} of 14 trials done"):
        search(tmp_path / "t", 14, WeightCell(stop=stop), BOTH)
    assert same(whole[1], search(tmp_path / "t", 14, WeightCell(), BOTH))


@pytest.mark.parametrize(("batch", "budgets"), [(4, [13, 15]), (3, [2, 4, 11]), (5, [14])])
def test_a_budget_that_ends_in_a_batch_can_be_raised(tmp_path, batch, budgets):
    complete = search(tmp_path / "a", 17, WeightCell(), BOTH, batch=batch)
    for budget in budgets:
        assert same(complete[:budget], search(tmp_path / "b", budget, WeightCell(), BOTH, batch=batch))
    assert same(complete, search(tmp_path / "b", 17, WeightCell(), BOTH, batch=batch))


def test_a_larger_budget_continues_and_a_smaller_one_is_its_beginning(whole, tmp_path):
    first = search(tmp_path / "t", 6, WeightCell(), BOTH)
    assert same(first, whole[1][:6])
    counted = WeightCell()
    assert same(whole[1], search(tmp_path / "t", 14, counted, BOTH)) and counted.flown == 8
    assert same(first, search(tmp_path / "t", 6, WeightCell(stop=0), BOTH))  # nothing is flown


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"vary": BOTH[:1]}, "other space"),
        ({"seed": 3}, "other seed"),
        ({"metric": "rmse"}, "other metric"),
        ({"given": [*HOVER, "wind=constant", "wind.velocity=[1,0,0]"]}, "other cells"),
    ],
)
def test_another_search_does_not_go_on_there(whole, changed, what):
    with pytest.raises(UsageError, match=f"holds a search with {what}"):
        search(whole[0], 14, WeightCell(), **{"vary": BOTH, **changed})


def test_settings_that_contradict_each_other_count_as_lost(tmp_path):
    """The first interval may not be longer than its share of the horizon."""
    trials = search(tmp_path / "t", 12, WeightCell(), ("controller.first_node=0..1",))
    assert trials[0].worth.lost == 0 and {0, 1} == {trial.worth.lost for trial in trials}
    assert trials[best_of(trials)].worth.lost == 0


def test_one_controller_at_a_time(tmp_path):
    for several in ("controller=nominal_mpc,perfect_mpc", "horizon=published,precise", "controller.nodes=10,20"):
        with pytest.raises(UsageError, match="one controller is tuned at a time"):
            search(tmp_path / "t", 4, WeightCell(), given=[*HOVER, several])


def test_a_controller_of_the_users_own_is_tuned_to_what_is_known_to_be_best(tmp_path):
    """Real flights: with 0.2 kg more than the 1 kg that is assumed, thrust without feedback must be 1.2 times larger,
    and z is off by (share / 1.2 - 1) g t^2 / 2 otherwise."""
    found = tuned(tmp_path, "payload=fixed", "payload.mass=0.2", flights=20)
    (share,) = found.trials[found.best].numbers
    assert share == pytest.approx(1.2, abs=0.03)
    off = sum(abs(1.0 / 1.2 - 1) * 9.81 * (0.02 * k) ** 2 / 2 for k in range(26)) / 26
    assert found.trials[0].worth.error == pytest.approx(off, rel=1e-6)


def tuned(folder, *more, **options):
    """A search of the share of that controller."""
    given = ["controller=open_loop", "plant=ideal", *HOVER, *more, "seed=7"]
    asked = Tune(vary=("controller.share=0.8..2",), **options)
    return tune(given, asked, conf=open_loop(folder / "mine"), out=folder / "t", isolate=False, figure=False)


def test_a_least_delay_margin_is_kept(tmp_path):
    """Real flights: the published weights stand 67 ms, a position weight of 831 less than 60."""
    given = [*HOVER, "plant=ideal"]
    trials = search(tmp_path / "t", 3, evaluate_cell, given=given, least_margin=0.06)
    assert trials[0].worth.margin == pytest.approx(0.067, abs=0.001)
    assert min(trial.worth.margin for trial in trials) < 0.06 <= trials[best_of(trials)].worth.margin
    short = [trial.worth.value for trial in trials if trial.worth.margin < 0.06]
    assert min(short) > max(trial.worth.value for trial in trials if trial.worth.margin >= 0.06)


def test_what_no_trial_has_is_said(tmp_path):
    """A margin of 400 ms; and more nodes than the rate allows fly nowhere."""
    asked = Tune(vary=("controller.nodes=10..40",), flights=4, delay_margin=0.4)
    given = ["controller=nominal_mpc", "controller.rate=10", *HOVER, "plant=ideal", "seed=7"]
    lines = "\n".join(tune(given, asked, out=tmp_path / "t", isolate=False, figure=False).lines)
    assert "no trial has the delay margin of 400 ms" in lines
    assert "of the trials completed no flight" in lines


def test_a_margin_is_asked_of_what_has_one(tmp_path):
    with pytest.raises(UsageError, match="none is known of open_loop"):
        tuned(tmp_path, delay_margin=0.05, flights=4)
