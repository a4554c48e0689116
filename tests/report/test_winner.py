"""Who is named best: hardly ever by chance, and where there is a difference. Error rates over many made-up sweeps."""

import math

import numpy as np
import pytest

from quadexp.log.store import write_table
from quadexp.plugins.page.report.answer import answer
from quadexp.plugins.page.report.sections import numbers
from quadexp.plugins.page.report.source import read_comparison
from quadexp.report.inference import log_ratio
from quadexp.report.metrics import to_columns
from quadexp.report.tables import error_table
from tests.report.results import verdicts
from tests.report.test_tables import row


def sweep(rng, controllers, *, conditions=1, seeds=5, factors=None):
    """Errors of one distribution for everybody, times `factors`; flights of one seed share what the noise did."""
    made = []
    for c in range(conditions):
        shared = np.exp(0.3 * rng.normal(size=seeds))
        for name in controllers:
            own = np.exp(0.3 * rng.normal(size=seeds))
            errors = 0.01 * (c + 1) * (factors or {}).get(name, 1.0) * shared * own
            made += [row(name, speed=4.0 + c, seed=s, error=float(e)) for s, e in enumerate(errors)]
    return made


@pytest.mark.parametrize("seeds", [3, 7, 12])
def test_a_real_difference_is_named(seeds):
    rng = np.random.default_rng(seeds)
    names = [f"way{i}_mpc" for i in range(4)]
    hits = 0
    for _ in range(40):
        (verdict,) = verdicts(sweep(rng, names, conditions=3, seeds=seeds, factors={"way2_mpc": 0.1}))
        hits += verdict.best and verdict.least == "way2_mpc"
    assert hits == (0 if seeds == 3 else 40)  # three seeds have 4 patterns of signs, and 3 pairs share the level


def test_the_ratio_by_hand():
    logs = np.log([1.1, 1.3, 1.2, 1.6])
    found = log_ratio(logs, 0.95)
    mean, error = logs.mean(), logs.std(ddof=1) / 2
    assert found.value == pytest.approx(math.exp(mean))
    limits = math.exp(mean - 3.182446 * error), math.exp(mean + 3.182446 * error)
    assert (found.low, found.high) == pytest.approx(limits)


def test_the_choice_among_k_is_paid_for():
    """One and the same pair of errors: significantly different when there are two, not any more among many."""
    rng = np.random.default_rng(0)
    base = np.exp(0.1 * rng.normal(size=6))
    ratios = np.exp(np.array([0.04, 0.05, 0.06, 0.10, 0.02, 0.05]))
    two = [row("a_mpc", seed=s, error=0.01 * e) for s, e in enumerate(base)]
    two += [row("b_mpc", seed=s, error=0.01 * e) for s, e in enumerate(base * ratios)]
    (verdict,) = verdicts(two)
    assert verdict.against["b_mpc"].p_holm == 2 / 2**6 and verdict.best
    more = [
        row(f"c{i}_mpc", seed=s, error=0.05 * e * float(np.exp(0.01 * rng.normal())))
        for i in range(8)
        for s, e in enumerate(base)
    ]
    (verdict,) = verdicts(two + more)
    assert verdict.against["b_mpc"].p_holm == 9 * 2 / 2**6 and not verdict.best


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
    comparison = results(tmp_path / "r", sweep(np.random.default_rng(5), FOUR, conditions=4, seeds=10, factors=factors))
    said = answer(comparison).gain
    assert comparison.verdict.best and "gp_mpc, the best of 4, significantly less than the next, rls_mpc" in said
    value, low, high = comparison.verdict.of_bound.ratio
    assert low < 1.25 < high and low < value < high
    assert f"{value:.3g} times [{low:.3g},\u00a0{high:.3g}] that of perfect_mpc" in said
    assert comparison.overall["gp_mpc"].p_holm < 0.05 and "not sure" not in answer(comparison).sure
    means = numbers(comparison).blocks[0].tables["mean_error"]
    assert sum(text.startswith("**") for row in means.rows for text in row) == 4
    assert "the best of 4, significantly less than the next" in error_table(comparison.rows).markdown()


def test_the_same_flights_twice_are_not_distinguishable():
    rows = sweep(np.random.default_rng(2), ["gp_mpc"], conditions=2, seeds=6)
    rows += [made | {"controller": "own_mpc"} for made in rows]
    (verdict,) = verdicts(rows)
    assert not verdict.best and verdict.alike and verdict.against[verdict.next].ratio.value == 1.0
    assert "best of" not in error_table(rows).markdown() and "**" not in error_table(rows).markdown()
