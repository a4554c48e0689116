"""Tables without a difference: every statement of a table together holds its level, whatever the errors look like.

Contestants fly several conditions, whose flights of a seed share half of their noise. The leaders have errors of one
distribution, so that each best, bold mark and significant difference among them is false. All flights are completed,
some are lost by chance, or a condition keeps two common ones. Intervals are Student's t: they name nobody, and contain
the truth for errors like those of flights.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from quadexp.plugins.bench.ranking import standings
from quadexp.plugins.page.view import points
from quadexp.report.frame import SweepFrame
from quadexp.report.pairing import Groups
from quadexp.report.significance import Tests
from quadexp.report.winner import best_of_lines, verdict
from tests.plugins.bench.rows import row as bench_row
from tests.report.test_tables import row

NAMES = ("nominal_mpc", "gp_mpc", "rls_mpc", "pid", "geometric")
CONDITIONS, SHARED, SPREAD = 3, 0.5, 0.3
LOST = {"balanced": 0.0, "lost at random": 0.08, "one keeps two": 0.0}
SHAPES = {
    "normal": lambda rng, size: rng.normal(size=size),
    "exponential": lambda rng, size: rng.exponential(size=size),
    "heavy": lambda rng, size: np.exp(1.2 * rng.normal(size=size)),
    "two modes": lambda rng, size: rng.choice([-1.0, 1.0], size) + 0.1 * rng.normal(size=size),
    "U-shaped": lambda rng, size: np.sin(np.pi * (rng.random(size) - 0.5)),
    # of errors that are a mean over a flight of correlated noise: skewed, and no normal in its logarithm either
    "flights": lambda rng, size: 5 * np.log(np.abs(smooth(rng, size)).mean(axis=0)),
}


def smooth(rng, size, steps=60, memory=0.9):
    """A first-order process of unit variance, (steps, *size)."""
    x = [rng.normal(size=size)]
    for _ in range(steps - 1):
        x.append(memory * x[-1] + math.sqrt(1 - memory**2) * rng.normal(size=size))
    return np.array(x)


def table(rng, seeds, pattern="balanced", shape="normal", *, ways=3, conditions=CONDITIONS, leaders=None, levels=1.0):
    """The rows of one table. leaders: how many share the least error, the last ones; the others have 20 times as much.
    levels: how much the conditions differ."""
    size, draw = (ways, conditions, seeds), SHAPES[shape]
    logs = math.sqrt(SHARED) * draw(rng, (ways, 1, seeds)) + math.sqrt(1 - SHARED) * draw(rng, size)
    logs = SPREAD * logs + levels * rng.normal(size=(1, conditions, 1))
    logs[: ways - (leaders or ways)] += math.log(20)
    lost = rng.random(size) < LOST[pattern]
    if pattern == "one keeps two":
        lost[0, 0, 2:] = True
    return [
        row(NAMES[k], seed=s, error=float(np.exp(logs[k, c, s])), variant=f"wind.velocity={c}")
        | ({"outcome": "lost", "mean_error": math.nan} if lost[k, c, s] else {})
        for k in range(ways)
        for c in range(conditions)
        for s in range(seeds)
    ]


def at_most(hits, tables, level):
    """Whether a level is held, by 3.7 standard errors: of 240 tests in which it is held, 3 % have one that says no. By
    three it was 27 %; what said no then, 7.1 % of 1,000 tables, had 5.2 % of 6,000."""
    return hits / tables <= level + 3.7 * math.sqrt(level * (1 - level) / tables)


def cases(default, every):
    """The cases of every day, of 60 tables, and all of them, of 1,000."""
    return [pytest.param(60, *one) for one in default] + [
        pytest.param(1000, *one, marks=pytest.mark.slow) for one in every
    ]


SEEDS = (2, 3, 6, 8, 10, 20)
SIZES = ((2, 1, 2), (2, 4, 2), (3, 3, 2), (5, 2, 3), (5, 1, 5))  # ways, conditions, leaders
DEFAULT = [(2, "two modes", *SIZES[1]), (8, "two modes", *SIZES[0]), (6, "exponential", *SIZES[1])]


@pytest.mark.parametrize(
    ("tables", "seeds", "shape", "ways", "conditions", "leaders"),
    cases(DEFAULT, [(seeds, shape, *size) for seeds in SEEDS for shape in SHAPES for size in SIZES]),
)
def test_a_false_best_is_named_or_bold_in_five_percent_of_the_tables_at_most(
    tables, seeds, shape, ways, conditions, leaders
):
    rng, hits = np.random.default_rng([seeds, ways, conditions, len(shape)]), 0
    for _ in range(tables):
        rows = table(rng, seeds, "balanced", shape, ways=ways, conditions=conditions, leaders=leaders)
        tests = Tests(Groups(rows, NAMES[0], ("mean_error",)))
        hits += bool(best_of_lines(tests, 0)) or verdict(tests, list(tests.groups.conditions)).best
    print(f"{seeds} seeds, {shape}, {leaders} of {ways} lead {conditions} conditions: {hits / tables}")
    assert at_most(hits, tables, 0.05)
    assert hits == 0 or seeds > 5  # 2^(1 - 5) is above the level


@pytest.mark.parametrize(
    ("tables", "seeds", "pattern", "shape"),
    cases(
        [(10, "one keeps two", "normal")],
        [(seeds, pattern, shape) for seeds in SEEDS for pattern in LOST for shape in ("normal", "flights")],
    ),
)
def test_any_false_difference_from_the_baseline(tables, seeds, pattern, shape):
    """In a line or over all of them, together; and how often the interval of the latter misses the truth."""
    rng, found, stated, missed = np.random.default_rng([seeds, len(pattern), len(shape)]), 0, 0, 0
    for _ in range(tables):
        tests = Tests(Groups(table(rng, seeds, pattern, shape), NAMES[0], ("mean_error",)))
        base, *others = tests.groups.contestants
        every = list(tests.groups.conditions)
        told = [tests.difference(who, base, at) for who in others for at in (every, *([c] for c in every))]
        found += any(difference.apart for difference in told)
        for difference in (tests.difference(who, base, every) for who in others):
            _, low, high = difference.ratio
            stated += math.isfinite(low)
            missed += math.isfinite(low) and not low <= 1 <= high
    print(f"{seeds} seeds, {pattern}, {shape}: {found / tables}, intervals {missed / max(stated, 1)}")
    assert at_most(found, tables, 0.05)
    # the two ratios of a table share their baseline: as many independent ones as tables
    assert at_most(missed / 2, max(stated / 2, 1), 0.05)


@pytest.mark.parametrize(("tables", "seeds", "cells"), cases([(2, 1), (6, 4)], [(s, c) for s in SEEDS for c in (1, 4)]))
def test_a_leaderboard(tables, seeds, cells):
    """Two equal entries: significantly different in 5 % at most, and the mean rank in its interval where there is
    one."""
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
