"""Who is named best: hardly ever by chance, and where there is a difference. Error rates over many made-up sweeps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from quadexp.log.store import write_table
from quadexp.report.inference import log_ratio
from quadexp.report.metrics import to_columns
from quadexp.report.page.answer import answer, odds
from quadexp.report.page.sections import numbers
from quadexp.report.page.source import read_comparison
from quadexp.report.statistics import compute_statistics
from quadexp.report.tables import error_table
from quadexp.report.winner import verdicts
from tests.report.test_tables import row

NOISES = {
    "lognormal": lambda rng, n: np.exp(0.3 * rng.normal(size=n)),
    "uniform": lambda rng, n: rng.uniform(0.5, 1.5, n),
    "exponential": lambda rng, n: 0.05 + rng.exponential(size=n),
}


def sweep(rng, controllers, *, conditions=1, seeds=5, noise="lognormal", factors=None):
    """Errors of one distribution for everybody, times `factors`; flights of one seed share what the noise did."""
    made = []
    for c in range(conditions):
        shared = np.exp(0.3 * rng.normal(size=seeds))
        for name in controllers:
            errors = 0.01 * (c + 1) * (factors or {}).get(name, 1.0) * shared * NOISES[noise](rng, seeds)
            made += [row(name, speed=4.0 + c, seed=s, error=float(e)) for s, e in enumerate(errors)]
    return made


def named(rows):
    """Whether the verdict or a mark of the table names a single best."""
    return any(v.best for v in verdicts(rows)) or any(
        s.best for s in compute_statistics(rows, metrics=["mean_error"], baseline="")
    )


SIZES = [(2, 1, 5), (4, 1, 5), (4, 3, 4), (8, 2, 3), (2, 2, 3), (4, 6, 1)]  # controllers, conditions, seeds


@pytest.mark.parametrize(
    ("noise", "count", "conditions", "seeds"),
    [
        pytest.param(noise, *size, marks=[pytest.mark.slow] * (noise != "lognormal" and size != (4, 3, 4)))
        for noise in NOISES
        for size in SIZES
    ],
)
def test_of_identical_distributions_a_single_best_is_named_in_at_most_five_percent(noise, count, conditions, seeds):
    rng = np.random.default_rng([count, conditions, seeds])
    names = [f"way{i}_mpc" for i in range(count)]
    hits = sum(named(sweep(rng, names, conditions=conditions, seeds=seeds, noise=noise)) for _ in range(120))
    assert hits / 120 <= 0.05 + 2 * math.sqrt(0.05 * 0.95 / 120)


def test_two_equal_ways_that_are_better_than_all_others_are_the_hardest_case():
    rng = np.random.default_rng(3)
    names = [f"way{i}_mpc" for i in range(5)]
    factors = dict.fromkeys(names[2:], 20.0)
    hits = sum(named(sweep(rng, names, seeds=5, factors=factors)) for _ in range(200))
    assert hits / 200 <= 0.05


@pytest.mark.parametrize("seeds", [3, 5, 12])
def test_a_real_difference_is_named(seeds):
    rng = np.random.default_rng(seeds)
    names = [f"way{i}_mpc" for i in range(4)]
    hits = 0
    for _ in range(40):
        (verdict,) = verdicts(sweep(rng, names, conditions=3, seeds=seeds, factors={"way2_mpc": 0.1}))
        hits += verdict.best and verdict.least == "way2_mpc"
    assert hits >= (35 if seeds == 3 else 38)


def test_the_ratio_and_its_p_by_hand():
    logs = np.log([1.1, 1.3, 1.2, 1.6])
    found = log_ratio(logs, 0.95)
    mean, error = logs.mean(), logs.std(ddof=1) / 2
    assert found.value == pytest.approx(math.exp(mean))
    limits = math.exp(mean - 3.182446 * error), math.exp(mean + 3.182446 * error)
    assert (found.low, found.high) == pytest.approx(limits)
    assert pytest.approx(1 - log_ratio(logs - mean + 3.182446 * error, 0.95).p, abs=1e-6) == 0.95


def test_the_choice_among_k_is_paid_for():
    """One and the same pair of errors: told apart when there are two, not any more among many."""
    rng = np.random.default_rng(0)
    base = np.exp(0.1 * rng.normal(size=5))
    ratios = np.exp(np.array([0.04, 0.05, 0.06, 0.10, 0.02]))
    two = [row("a_mpc", seed=s, error=0.01 * e) for s, e in enumerate(base)]
    two += [row("b_mpc", seed=s, error=0.01 * e) for s, e in enumerate(base * ratios)]
    p = log_ratio(np.log(ratios)).p
    assert verdicts(two)[0].p == pytest.approx(2 * p) and verdicts(two)[0].best
    more = [
        row(f"c{i}_mpc", seed=s, error=0.05 * e * float(np.exp(0.01 * rng.normal())))
        for i in range(8)
        for s, e in enumerate(base)
    ]
    (verdict,) = verdicts(two + more)
    assert verdict.p == pytest.approx(10 * p) and verdict.best == (10 * p < 0.05)


def results(root, rows):
    root.mkdir(parents=True)
    times = {"solve_time_median": 3e-5, "solve_time_p99": 6e-5, "backend": "compiled"}
    rows = [made | times | {"key": f"{i:020x}"} for i, made in enumerate(rows)]
    record = {"metric": "mean_error", "grids": [], "conditions": [], "versions": {}, "provenance": {}}
    write_table(root / "results.parquet", to_columns(rows), record, "results")
    return read_comparison(root)


FOUR = ["nominal_mpc", "linear_drag_mpc", "gp_mpc", "rls_mpc", "perfect_mpc"]


def test_the_page_names_a_real_best_and_gives_its_ratio_to_the_bound_an_interval(tmp_path):
    factors = {"gp_mpc": 0.1, "linear_drag_mpc": 0.5, "rls_mpc": 0.4, "perfect_mpc": 0.08}
    comparison = results(tmp_path / "r", sweep(np.random.default_rng(5), FOUR, conditions=4, seeds=8, factors=factors))
    said = answer(comparison).gain
    assert comparison.verdict.best and "gp_mpc, the best of 4, significantly less than the next, rls_mpc" in said
    value, low, high, _ = comparison.verdict.bound_ratio
    assert low < 1.25 < high and low < value < high
    assert f"{value:.3g} times [{low:.3g},\u00a0{high:.3g}] that of perfect_mpc." in said
    means = numbers(comparison).blocks[0].tables["mean_error"]
    assert sum(text.startswith("**") for row in means.rows for text in row) == 4
    assert "the best of 4, significantly less than the next" in error_table(comparison.rows).markdown()


def test_the_same_flights_twice_are_not_distinguishable():
    rows = sweep(np.random.default_rng(2), ["gp_mpc"], conditions=2, seeds=6)
    rows += [made | {"controller": "own_mpc"} for made in rows]
    (verdict,) = verdicts(rows)
    assert not verdict.best and verdict.alike and verdict.ratio[0] == 1.0
    assert "not distinguishable from" in error_table(rows).markdown() and "**" not in error_table(rows).markdown()


def test_how_sure_is_said_in_words_that_follow_the_test(tmp_path):
    """Equal controllers are "not sure" in most of many draws, a real difference is sure, two pairs say nothing."""
    rng, doubted, who, factors = np.random.default_rng(3), 0, ["nominal_mpc", "gp_mpc"], {"gp_mpc": 0.1}
    for i in range(4):
        comparison = results(tmp_path / str(i), sweep(rng, who, conditions=2, seeds=6))
        said, pooled = answer(comparison).sure, comparison.overall["gp_mpc"]
        assert ("not sure" in said) == (pooled.p_holm >= 0.05)
        doubted += "not sure" in said
    assert doubted >= 3
    real = sweep(np.random.default_rng(5), who, conditions=4, seeds=8, factors=factors)
    said = answer(results(tmp_path / "real", real)).sure
    assert said.startswith("How sure: fairly.") and "8 seeds" in said and "With other seeds" in said
    few = sweep(np.random.default_rng(5), who, conditions=1, seeds=2, factors=factors)
    assert "not at all yet. 2 seeds" in answer(results(tmp_path / "few", few)).sure


def test_odds():
    said = ["in 30 of 100 times", "once in 20 times", "once in 2 000 times", "once in 2 300 times"]
    never = "less than once in a million times"
    assert [odds(p) for p in (0.3, 0.05, 0.0005, 0.00042, 1e-9, 0.0)] == [*said, never, never]
