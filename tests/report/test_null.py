"""Tables without a difference: every p holds its level, and every interval contains the truth, or neither is stated.

Three contestants fly several conditions, whose flights of a seed share most of their noise (correlation .9), as those
that differ only in the world do. Their errors have one distribution, so each significant difference is false.
From two to twenty seeds; all flights are completed, some are lost by chance, or a condition keeps two common ones.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from quadexp.bench.ranking import standings
from quadexp.report.frame import SweepFrame
from quadexp.report.statistics import compute_statistics, overall
from quadexp.report.view import points
from quadexp.report.winner import verdicts
from tests.bench.rows import row as bench_row
from tests.report.test_tables import row

NAMES = ("nominal_mpc", "gp_mpc", "rls_mpc")
CONDITIONS, SHARED, SPREAD = 3, 0.9, 0.2
LOST = {"balanced": 0.0, "lost at random": 0.08, "one keeps two": 0.0}
ERRORS = {
    "normal": lambda rng, size: rng.normal(size=size),
    # of errors that are a mean over a flight of correlated noise: skewed, and no normal in its logarithm either
    "flights": lambda rng, size: 5 * np.log(np.abs(smooth(rng, size)).mean(axis=0)),
}


def smooth(rng, size, steps=60, memory=0.9):
    """A first-order process of unit variance, (steps, *size)."""
    x = [rng.normal(size=size)]
    for _ in range(steps - 1):
        x.append(memory * x[-1] + math.sqrt(1 - memory**2) * rng.normal(size=size))
    return np.array(x)


def table(rng, seeds, pattern, errors="normal", levels=1.0):
    """The rows of one table. levels: how much the conditions differ."""
    shape = (len(NAMES), CONDITIONS, seeds)
    logs = math.sqrt(SHARED) * ERRORS[errors](rng, (len(NAMES), 1, seeds))
    logs = SPREAD * (logs + math.sqrt(1 - SHARED) * ERRORS[errors](rng, shape)) + levels * rng.normal(
        size=(1, CONDITIONS, 1)
    )
    lost = rng.random(shape) < LOST[pattern]
    if pattern == "one keeps two":
        lost[0, 0, 2:] = True
    return [
        row(name, seed=s, error=float(np.exp(logs[k, c, s])), variant=f"wind.velocity={c}")
        | ({"outcome": "lost", "mean_error": math.nan} if lost[k, c, s] else {})
        for k, name in enumerate(NAMES)
        for c in range(CONDITIONS)
        for s in range(seeds)
    ]


def at_most(hits, tables, level):
    """Whether a level is held, by three standard errors."""
    return hits / tables <= level + 3 * math.sqrt(level * (1 - level) / tables)


def cases(default, every):
    """The cases of every day, of 100 tables, and all of them, of 2,000."""
    return [pytest.param(100, *one) for one in default] + [
        pytest.param(2000, *one, marks=pytest.mark.slow) for one in every
    ]


SEEDS = (2, 3, 6, 10, 20)
SWEEPS = [(seeds, pattern, "normal") for pattern in LOST for seeds in SEEDS]


@pytest.mark.parametrize(
    ("tables", "seeds", "pattern", "errors"),
    cases(
        [(3, "balanced", "normal"), (10, "one keeps two", "normal")],
        [*SWEEPS, *((seeds, "balanced", "flights") for seeds in SEEDS)],
    ),
)
def test_a_sweep(tables, seeds, pattern, errors):
    rng = np.random.default_rng([seeds, tables, len(pattern), len(errors)])
    counts = dict.fromkeys(("pooled", "lines", "best", "marked", "sure", "ratios", "missed"), 0)
    for _ in range(tables):
        rows = table(rng, seeds, pattern, errors)
        pooled, statistics = overall(rows), compute_statistics(rows, metrics=["mean_error"])
        (verdict,) = verdicts(rows)
        counts["pooled"] += any(one.significant for one in pooled)
        counts["lines"] += any(one.significant for one in statistics)
        counts["best"] += verdict.best
        counts["marked"] += any(one.best for one in statistics)
        counts["sure"] += verdict.p < 0.001
        for limits in ((one.reduction_low, one.reduction_high) for one in pooled):
            counts["ratios"] += math.isfinite(limits[0])
            counts["missed"] += not limits[0] <= 0 <= limits[1] and math.isfinite(limits[0])
    print(f"{seeds} seeds, {pattern}, {errors}:", {name: round(n / tables, 4) for name, n in counts.items()})
    for name, level in (("pooled", 0.05), ("lines", 0.05), ("best", 0.025), ("marked", 0.025), ("sure", 0.001)):
        assert at_most(counts[name], tables, level), name
    # the two ratios of a table share their baseline: as many independent ones as tables
    assert at_most(counts["missed"] / 2, max(counts["ratios"] / 2, 1), 0.05)


@pytest.mark.parametrize(("tables", "seeds", "cells"), cases([(2, 1), (6, 4)], [(s, c) for s in SEEDS for c in (1, 4)]))
def test_a_leaderboard(tables, seeds, cells):
    """Two equal entries: told apart in 5 % at most, and the mean rank in its interval where there is one."""
    rng, apart, stated, missed = np.random.default_rng([seeds, cells]), 0, 0, 0
    for _ in range(tables):
        shared = rng.normal(size=(2, seeds, 1))
        errors = np.exp(math.sqrt(SHARED) * shared + math.sqrt(1 - SHARED) * rng.normal(size=(2, seeds, cells)))
        lost = rng.random((2, seeds, cells)) < LOST["lost at random"]
        rows = [
            bench_row(f"entry{k}", errors[k, s, c], seed=s, world=str(c), outcome="lost" if lost[k, s, c] else "ok")
            for k in range(2)
            for s in range(seeds)
            for c in range(cells)
        ]
        first, second = standings(rows)
        apart += not second.level
        stated += math.isfinite(first.rank_low)
        missed += math.isfinite(first.rank_low) and not first.rank_low <= 1.5 <= first.rank_high
    print(f"{seeds} seeds, {cells} cells: apart {apart / tables}, stated {stated / tables}, missed {missed / tables}")
    assert at_most(apart, tables, 0.05) and at_most(missed, max(stated, 1), 0.05)


@pytest.mark.parametrize(("tables", "seeds"), cases([(3,)], [(seeds,) for seeds in SEEDS]))
def test_a_figure(tables, seeds):
    """The mean of a place over conditions that share their noise, and its interval."""
    rng, held = np.random.default_rng(seeds), 0
    for _ in range(tables):
        rows = table(rng, seeds, "balanced", levels=0.0)
        rows = [{**one, "plant": one["variant"], "mean_error": math.log(one["mean_error"])} for one in rows]
        rows = [one for one in rows if one["controller"] == NAMES[0]]
        (place,) = points(SweepFrame(rows, Path(), {}), ["controller"], "mean_error", others=["plant"]).values()
        held += place.low <= 0 <= place.high
    assert at_most(tables - held, tables, 0.05)
