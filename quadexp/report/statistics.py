"""Statistics of a comparison over the seeds: one `Statistic` per metric and contestant, in each condition and over all.

Two means: `mean` over the contestant's own completed flights, and `common_mean` over the common flights, which tables
show. Flights that were not completed are counted by outcome, and lower the success rate. A contestant is compared with
the baseline seed by seed, difference = contestant - baseline, over the flights that both completed; the others are
counted in `left_out` by cause. Intervals: inference.py; common flights, conditions and pairs: pairing.py; every p, and
over how many comparisons it is corrected: significance.py; who is best: winner.py.

Over all conditions (`overall`) errors differ tenfold, so the logarithms of their ratios are averaged over the
conditions of a seed, and the seeds are the values: reduction = 100 (1 - ratio), the ratio of inference.py. The interval
is for new seeds of these conditions, not for new trajectories; `between` says what it is in the single conditions.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from quadexp.log.outcome import FAILURES
from quadexp.log.schema import describe
from quadexp.names import sha256_of
from quadexp.report import inference
from quadexp.report.metrics import is_own, tabled
from quadexp.report.pairing import BASELINE, Condition, Contestant, Flights, Flown, Groups, Row, causes_text
from quadexp.report.significance import Difference, Tests, place_texts
from quadexp.report.table import csv_text
from quadexp.report.text import count, probability
from quadexp.report.winner import best_of_lines

# No comparison: they are not paired by noise.
DESCRIBED = ("solve_time_median", "solve_time_p99", "saturated_share", "command_change")
CONFIDENCE = 0.95  # of every interval, unless a user asks for another


def compared(rows: Sequence[Row]) -> tuple[str, ...]:
    """The metrics of some rows that are compared with the baseline."""
    known = dict.fromkeys((*tabled(), "attitude_rmse"))
    return tuple(name for name in known if not is_own(name) or (rows and name in rows[0]))


NAN = math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistic:
    """One metric of one contestant in one condition; over all of them where plant and trajectory are "".

    mean, low, high, std, baseline_mean, difference*: in `unit`, NaN if not defined. reduction*: percent, positive if
    the contestant's mean is smaller than the baseline's over the same pairs. effect: of the paired
    differences, positive if smaller than the baseline.

    seeds: cells requested. trials: those that at least one contestant could fly. n: flights in the mean. common:
    flights in the common mean, 0 if it is not compared. best_p: see winner.best_of_lines, NaN if it is not the best of
    its line. baseline: label of the baseline, "" for none. interval: method of [low, high]. p, p_holm, comparisons: see
    significance.Difference. p_least: the smallest p that so many pairs can give. speed: m/s, NaN for a trajectory
    without one.

    conditions, units: over all conditions, number of those with pairs, and of their seeds, which are the values.
    between: the least and the largest reduction of a single condition, in words.
    """

    metric: str
    unit: str
    plant: str = ""
    vehicle: str = ""
    trajectory: str = ""
    speed: float = NAN
    setting: str = ""
    controller: str
    model: str
    variant: str
    label: str
    confidence: float
    seeds: int = 0
    trials: int = 0
    n: int = 0
    mean: float = NAN
    low: float = NAN
    high: float = NAN
    std: float = NAN
    interval: str = ""
    common: int = 0
    common_mean: float = NAN
    common_low: float = NAN
    common_high: float = NAN
    common_std: float = NAN
    common_interval: str = ""
    left_corridor: int = 0
    lost: int = 0
    solver_failed: int = 0
    infeasible: int = 0
    failed: int = 0
    success: float = NAN
    success_low: float = NAN
    success_high: float = NAN
    best_p: float = NAN
    baseline: str = ""
    conditions: int = 1
    units: int = 0
    pairs: int = 0
    left_out: str = ""
    baseline_mean: float = NAN
    difference: float = NAN
    difference_low: float = NAN
    difference_high: float = NAN
    reduction: float = NAN
    reduction_low: float = NAN
    reduction_high: float = NAN
    effect: float = NAN
    p: float = NAN
    p_holm: float = NAN
    p_least: float = NAN
    comparisons: int = 0
    between: str = ""

    @property
    def is_overall(self) -> bool:
        return not self.trajectory

    @property
    def contestant(self) -> Contestant:
        return Contestant(self.controller, self.model, self.variant)

    @property
    def failures(self) -> dict[str, int]:
        """Outcome -> count, of the flights that were not completed."""
        return {name: count for name in FAILURES if (count := getattr(self, name))}

    @property
    def flown(self) -> Flights:
        return Flights(self.seeds - sum(self.failures.values()), self.trials)

    @property
    def best(self) -> bool:
        """Whether it has the least error of its line, significantly, and nobody flew more."""
        return self.best_p < 1 - self.confidence  # False for NaN

    @property
    def significant(self) -> bool:
        return self.p_holm < 1 - self.confidence  # False for NaN

    @property
    def testable(self) -> bool:
        """Whether so many seeds can show a difference."""
        return self.significant or self.comparisons * self.p_least < 1 - self.confidence

    @property
    def chance(self) -> str:
        """Seeds and p, such as "5 seeds, p = 0.13", or "2 seeds, too few for a test"."""
        seeds = count(self.units, "seed")
        return f"{seeds}, {probability(self.p_holm)}" if self.testable else f"{seeds}, too few for a test"

    def text(self) -> str:
        """Such as "mine: 98.7 % [98.6, 98.8] less than nominal_mpc over 4 conditions (20 seeds, p = 0.0002), 97.1 %
        less in lemniscate 8 m/s to 99.1 % less in circle 4 m/s"."""
        if not self.pairs:
            return f"{self.label}: no pair with {self.baseline} ({self.left_out})"
        change = change_text(self.reduction, self.reduction_low, self.reduction_high, f"than {self.baseline}")
        about = self.chance + (f"; left out: {self.left_out}" if self.left_out else "")
        over = count(self.conditions, "condition")
        return f"{self.label}: {change} over {over} ({about})" + (f", {self.between}" if self.between else "")


def change_text(reduction: float, low: float = NAN, high: float = NAN, than: str = "") -> str:
    """Such as "98.7 % [98.6, 98.8] less than nominal_mpc"."""
    word = "less"
    if not reduction >= 0:
        word = "more"
        low, high = -high, -low
    limits = "" if math.isnan(low) else f" [{low:.1f}, {high:.1f}]"
    return f"{abs(reduction):.1f} %{limits} {word} {than}".rstrip()


def compute_statistics(
    rows: Sequence[Row], *, metrics: Sequence[str] = (), baseline: str = BASELINE, confidence: float = CONFIDENCE
) -> list[Statistic]:
    """The statistics of result rows, metric by metric. metrics: () for all. baseline: name of a controller."""
    metrics = metrics or (*compared(rows), *DESCRIBED)
    groups = Groups(rows, baseline, metrics)
    return of_lines([Tests(groups, place, confidence) for place in range(len(metrics))], metrics)


def of_lines(tests_of: Sequence[Tests], metrics: Sequence[str]) -> list[Statistic]:
    """The statistics of every contestant and condition. tests_of: a test for each metric, of the same groups."""
    groups = tests_of[0].groups
    confidence = tests_of[0].confidence
    about: dict[tuple[Condition, Contestant], dict[str, Any]] = {}  # what is the same for every metric
    pairs: dict[tuple[Condition, Contestant], list[tuple[Flown, Flown]]] = {}
    for condition in groups.conditions:
        where = condition._asdict() | {"speed": NAN if condition.speed is None else condition.speed}
        for contestant, flown in groups.flights([condition]).items():
            at = (condition, contestant)
            rival = groups.baseline(contestant)
            low, high = inference.success_interval(flown.ended, flown.trials, confidence)
            about[at] = {**where, **_whose(groups, contestant, confidence), **_tally(groups.cells[at], flown.trials)}
            about[at] |= {"success_low": low, "success_high": high}
            if rival is not None:
                pairs[at], causes = groups.pairs(condition, contestant, rival)
                about[at] |= {"baseline": groups.labels[rival], "left_out": causes_text(causes)}
    statistics: list[Statistic] = []
    for place, (tests, metric) in enumerate(zip(tests_of, metrics, strict=True)):
        unit = describe(metric, "results").unit
        best = best_of_lines(tests, place) if metric not in DESCRIBED else {}
        for at, flights in groups.cells.items():
            condition, contestant = at
            among = groups.lines[at[0]]
            seeds = among.seeds.get(condition, frozenset()) if contestant in among.compared else frozenset[int]()
            values = np.array([flown.values[place] for flown in flights if flown.outcome == "ok"])
            shared = groups.values(condition, contestant, place, seeds)
            every = _mean_fields(values, confidence)
            # The common flights are among its own: as many are the same.
            common = every if len(shared) == len(values) else _mean_fields(shared, confidence)
            fields = about[at] | every
            fields |= {"common" if name == "n" else f"common_{name}": value for name, value in common.items()}
            if metric in DESCRIBED:
                fields |= {"baseline": "", "left_out": ""}
            elif pairs.get(at) and (rival := groups.baseline(contestant)) is not None:
                fields |= _comparison(pairs[at], place, confidence)
                fields |= _test(tests.difference(contestant, rival, [condition]))
            statistics.append(Statistic(metric=metric, unit=unit, best_p=best.get(at, NAN), **fields))
    return statistics


def _whose(groups: Groups, contestant: Contestant, confidence: float) -> dict[str, Any]:
    who = {"controller": contestant.controller, "model": contestant.model, "variant": contestant.settings}
    return {**who, "label": groups.labels[contestant], "confidence": confidence}


def _tally(flights: Sequence[Flown], trials: int) -> dict[str, Any]:
    """How flights ended: counts by outcome, and the success rate. A cell without a result (failed) is a trial."""
    outcomes = Counter(f.outcome if f.outcome in ("ok", *FAILURES) else "failed" for f in flights)
    counts = {"seeds": len(flights), "trials": trials, **{name: outcomes[name] for name in FAILURES}}
    return {**counts, "success": outcomes["ok"] / trials if trials else NAN}


def _mean_fields(values: np.ndarray, confidence: float) -> dict[str, Any]:
    """Number, mean, its interval and the standard deviation of the finite values; NaN if there are none."""
    values = values[np.isfinite(values)]
    low, high, method = inference.mean_interval(values, confidence, least=0.0)
    mean = float(np.mean(values)) if len(values) else NAN
    std = float(np.std(values, ddof=1)) if len(values) > 1 else NAN
    return {"n": len(values), "mean": mean, "low": low, "high": high, "std": std, "interval": method}


def _comparison(pairs: Sequence[tuple[Flown, Flown]], place: int, confidence: float) -> dict[str, Any]:
    values, others = (np.array([pair[side].values[place] for pair in pairs]) for side in (0, 1))
    differences = values - others
    base = float(np.mean(others))
    limits = inference.mean_interval(differences, confidence)
    relative = inference.reduction_interval(values, others, confidence)
    return {
        "pairs": len(pairs),
        "baseline_mean": base,
        "difference": float(np.mean(differences)),
        "difference_low": limits.low,
        "difference_high": limits.high,
        "reduction": _reduction(float(np.mean(values)) / base) if base > 0 else NAN,
        "reduction_low": relative.low,
        "reduction_high": relative.high,
        "effect": inference.rank_biserial(differences),
    }


def _test(difference: Difference) -> dict[str, Any]:
    """p, and the least p that so many seeds can give; no p for copies of one flight."""
    tested = 0 if math.isnan(difference.p) else difference.comparisons
    about = {"units": len(difference.seeds), "p_least": difference.least, "comparisons": tested}
    return {**about, "p": difference.p, "p_holm": difference.p_holm}


def overall(
    rows: Sequence[Row], *, metric: str = "mean_error", baseline: str = BASELINE, confidence: float = CONFIDENCE
) -> list[Statistic]:
    """Every contestant that has a baseline, over all conditions."""
    groups = Groups(rows, baseline, (metric,))
    return pooled(Tests(groups, 0, confidence), list(groups.conditions), metric)


def pooled(tests: Tests, conditions: Sequence[Condition], metric: str) -> list[Statistic]:
    """Every contestant that has a baseline, over all conditions, or all of a plant and vehicle; see the module."""
    groups = tests.groups
    unit = describe(metric, "results").unit
    flights = groups.flights(conditions)
    statistics = []
    for contestant in flights:
        if (rival := groups.baseline(contestant)) is None:
            continue
        difference = tests.difference(contestant, rival, conditions)
        flown = [flight for at in conditions for flight in groups.cells.get((at, contestant), ())]
        statistics.append(
            Statistic(
                metric=metric,
                unit=unit,
                baseline=groups.labels[rival],
                left_out=causes_text(difference.causes),
                conditions=len(difference.by_condition),
                pairs=difference.flights,
                reduction=_reduction(difference.ratio.value),
                reduction_low=_reduction(difference.ratio.high),
                reduction_high=_reduction(difference.ratio.low),
                between=_between(difference) if difference.flights else "",
                effect=inference.rank_biserial(difference.logs),
                **_whose(groups, contestant, tests.confidence),
                **_tally(flown, flights[contestant].trials),
                **_test(difference),
            )
        )
    return statistics


def _between(difference: Difference) -> str:
    """The least and the largest change in a single condition, and where; "" where they are the same."""
    places = place_texts(difference.by_condition)
    ends = sorted(difference.by_condition, key=lambda at: -difference.by_condition[at])
    low = change_text(_reduction(difference.by_condition[ends[0]]))
    high = change_text(_reduction(difference.by_condition[ends[-1]]))
    return f"{low} in {places[ends[0]]} to {high} in {places[ends[-1]]}" if low != high else ""


def _reduction(ratio: float) -> float:
    return 100 * (1 - ratio)


KINDS = {field.name: {"int": np.int64, "float": float, "str": object}[str(field.type)] for field in fields(Statistic)}


@dataclass(frozen=True)
class Statistics:
    """rows: per metric and contestant, in each condition and over all. flights: the result rows they are of."""

    rows: list[Statistic]
    flights: Sequence[Row]
    baseline: str
    confidence: float

    def of(self, metric: str) -> list[Statistic]:
        return [row for row in self.rows if row.metric == metric and not row.is_overall]

    def record(self, metric: str) -> list[dict[str, Any]]:
        """Of one metric, for JSON."""
        return [asdict(row) for row in self.of(metric)]

    @cached_property
    def csv(self) -> str:
        return statistics_csv(self.rows)

    @cached_property
    def fingerprint(self) -> str:
        """20 hex digits of all numbers."""
        return sha256_of(self.csv)[:20]


def results_statistics(rows: Sequence[Row], *, baseline: str = BASELINE, confidence: float = CONFIDENCE) -> Statistics:
    """The statistics of result rows: of each metric, line by line and over all conditions."""
    chosen = compared(rows)
    metrics = (*chosen, *DESCRIBED)
    groups = Groups(rows, baseline, metrics)
    tests = [Tests(groups, place, confidence) for place in range(len(metrics))]
    over_all = [
        s for test, metric in zip(tests, chosen, strict=False) for s in pooled(test, [*groups.conditions], metric)
    ]
    return Statistics([*of_lines(tests, metrics), *over_all], rows, baseline, confidence)


def statistics_csv(statistics: Sequence[Statistic]) -> str:
    """Numbers in full precision, nothing for NaN."""
    return csv_text(list(KINDS), ([getattr(row, name) for name in KINDS] for row in statistics))
