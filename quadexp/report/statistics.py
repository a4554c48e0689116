"""Statistics of a comparison over the seeds: one `Statistic` per metric and contestant, in each condition and over all.

Two means: `mean` over the contestant's own completed flights, and `common_mean` over the common flights, which tables
show. Flights that were not completed are counted by outcome, and lower the success rate. A contestant is compared with
the baseline seed by seed, difference = contestant - baseline, over the common flights; the others are counted in
`left_out` by cause. p-values are corrected for all comparisons of one metric. Equations: inference.py; common flights,
conditions and pairs: pairing.py; who is best: winner.py.

Over all conditions (`overall`) errors differ tenfold, so the logarithms of their ratios are averaged over the
conditions of a seed, and the seeds are the values (pairing.py):

    reduction = 100 (1 - ratio), the ratio of inference.py
    p: paired permutation of the logarithms, corrected by Holm for the number of contestants

The interval is for new seeds of these conditions, not for new trajectories.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from quadexp.log.outcome import FAILURES
from quadexp.log.schema import describe
from quadexp.report import inference
from quadexp.report.metrics import SHOWN
from quadexp.report.pairing import Condition, Contestant, Flights, Flown, Groups, Row, causes_text, seed_means, whole
from quadexp.report.table import csv_text
from quadexp.report.text import count, probability, too_few
from quadexp.report.winner import best_of_lines

COMPARED = tuple(dict.fromkeys((*SHOWN, "attitude_rmse")))
DESCRIBED = ("solve_time_median", "solve_time_p99", "saturated_share")  # no comparison: they are not paired by noise
BASELINE = "nominal_mpc"
CONFIDENCE = 0.95
NAN = math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistic:
    """One metric of one contestant in one condition; over all of them where plant and trajectory are "".

    mean, low, high, std, baseline_mean, difference*: in `unit`, NaN if not defined. reduction*: percent, positive if
    the contestant's mean is smaller than the baseline's over the same pairs. effect: of the paired
    differences, positive if smaller than the baseline.

    seeds: cells requested. trials: those that at least one contestant could fly. n: flights in the mean. common:
    flights in the common mean, 0 if it is not compared. best_p: see winner.best_of_lines, corrected for the number of
    lines, NaN if it cannot be marked as best. baseline: label of the baseline, "" for none. interval: method of [low,
    high]. p_least: the smallest p that so many pairs can give. comparisons: number that p_holm is corrected for. speed:
    m/s, NaN for a trajectory without one.

    conditions, units: over all conditions, number of those with pairs, and of their seeds, which are the values.
    own_reduction, own_pairs: over all flights that both completed.
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
    own_pairs: int = 0
    own_reduction: float = NAN

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
        return self.comparisons * self.p_least < 1 - self.confidence

    @property
    def chance(self) -> str:
        """Seeds and p, such as "5 seeds, p = 0.13", or "2 seeds cannot show p < 0.05: at least 6 are needed"."""
        if self.testable:
            return f"{count(self.units, 'seed')}, {probability(self.p_holm)}"
        return too_few(self.units, inference.least_seeds(max(1, self.comparisons), self.confidence), self.confidence)

    def text(self) -> str:
        """Such as "gp_mpc: 98.7 % [98.6, 98.8] less than nominal_mpc over 4 conditions (20 seeds, p < 0.0001)"."""
        if not self.pairs:
            return f"{self.label}: no pair with {self.baseline} ({self.left_out})"
        low, high = self.reduction_low, self.reduction_high
        word, low, high = ("less", low, high) if self.reduction >= 0 else ("more", -high, -low)
        limits = "" if math.isnan(low) else f" [{low:.1f}, {high:.1f}]"
        about = self.chance + (f"; left out: {self.left_out}" if self.left_out else "")
        if self.own_pairs > self.pairs:
            change = f"{abs(self.own_reduction):.1f} % {'less' if self.own_reduction >= 0 else 'more'}"
            about += f"; over all {self.own_pairs} that both completed: {change}"
        over = count(self.conditions, "condition")
        return f"{self.label}: {abs(self.reduction):.1f} %{limits} {word} than {self.baseline} over {over} ({about})"


def compute_statistics(
    rows: Sequence[Row],
    *,
    metrics: Sequence[str] = (*COMPARED, *DESCRIBED),
    baseline: str = BASELINE,
    confidence: float = CONFIDENCE,
) -> list[Statistic]:
    """The statistics of result rows, metric by metric. baseline: name of a controller."""
    groups = Groups(rows, baseline, metrics)
    about: dict[tuple[Condition, Contestant], dict[str, Any]] = {}  # what is the same for every metric
    pairs: dict[tuple[Condition, Contestant], list[tuple[Flown, Flown]]] = {}
    for condition, among in groups.lines.items():
        where = condition._asdict() | {"speed": NAN if condition.speed is None else condition.speed}
        for contestant, flown in groups.flights([condition]).items():
            at, rival = (condition, contestant), groups.baseline(contestant)
            low, high = inference.success_interval(flown.ended, flown.trials, confidence)
            about[at] = {**where, **_whose(groups, contestant, confidence), **_tally(groups.cells[at], flown.trials)}
            about[at] |= {"success_low": low, "success_high": high}
            if rival is not None:
                pairs[at], causes = groups.pairs(condition, contestant, rival, among)
                about[at] |= {"baseline": groups.labels[rival], "left_out": causes_text(causes)}
    statistics: list[Statistic] = []
    for place, metric in enumerate(metrics):
        of_metric, unit = [], describe(metric, "results").unit
        best = best_of_lines(groups, place, confidence) if metric in COMPARED else {}
        for at, flights in groups.cells.items():
            (condition, contestant), among = at, groups.lines[at[0]]
            seeds = among.seeds.get(condition, frozenset()) if contestant in among.compared else frozenset[int]()
            values = np.array([flown.values[place] for flown in flights if flown.outcome == "ok"])
            shared = groups.values(condition, contestant, place, seeds)
            every = _mean_fields(values, confidence)
            # The common flights are among its own: as many are the same.
            common = every if len(shared) == len(values) else _mean_fields(shared, confidence)
            fields = about[at] | every
            fields |= {"common" if name == "n" else f"common_{name}": value for name, value in common.items()}
            if metric not in COMPARED:
                fields |= {"baseline": "", "left_out": ""}
            elif pairs.get(at):
                fields |= _comparison(pairs[at], place, confidence)
            of_metric.append(Statistic(metric=metric, unit=unit, best_p=best.get(at, NAN), **fields))
        statistics += corrected(of_metric)
    return statistics


def corrected(statistics: Sequence[Statistic]) -> list[Statistic]:
    """The same, with p by Holm over those that have one."""
    corrected = inference.holm(np.array([statistic.p for statistic in statistics]))
    tests = int(np.count_nonzero(~np.isnan(corrected)))
    return [
        statistic if math.isnan(p) else replace(statistic, p_holm=float(p), comparisons=tests)
        for statistic, p in zip(statistics, corrected, strict=True)
    ]


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
    differences, base = values - others, float(np.mean(others))
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
        **_test(differences, inference.vary(values) or inference.vary(others)),
    }


def _test(differences: np.ndarray, varying: bool) -> dict[str, Any]:
    """Effect and p of the differences of some seeds, (n,), and the least p that so many can give; no p for copies of
    one flight."""
    effect = {"effect": inference.rank_biserial(differences)}
    if len(differences) < 2 or not varying:
        return effect
    return {**effect, "p": inference.paired_permutation(differences), "p_least": inference.least_p(len(differences))}


def overall(
    rows: Sequence[Row], *, metric: str = "mean_error", baseline: str = BASELINE, confidence: float = CONFIDENCE
) -> list[Statistic]:
    """Every contestant that has a baseline; see the module's equations."""
    groups = Groups(rows, baseline, (metric,))
    among = {world: groups.common(conditions) for world, conditions in groups.worlds.items()}
    flights = {condition: groups.flights([condition]) for condition in groups.conditions}
    pooled = []
    for contestant in groups.contestants:
        if (rival := groups.baseline(contestant)) is None:
            continue
        logs: dict[tuple[Condition, int], float] = {}
        every: list[float] = []  # the mean of each condition, also beyond the common flights
        own_pairs = trials = 0
        causes: Counter[str] = Counter()
        for condition in dict.fromkeys(at for at, who in groups.cells if who in (contestant, rival)):
            pairs, left_out = groups.pairs(condition, contestant, rival, among[condition.world])
            trials += flights[condition].get(contestant, Flights(0, 0)).trials
            causes.update(left_out)
            by_seed = _logs(pairs)
            if len(by_seed) < len(pairs):
                causes["without an error above zero"] += len(pairs) - len(by_seed)
            logs |= {(condition, seed): log for seed, log in by_seed.items()}
            if beyond := _logs(groups.pairs(condition, contestant, rival)[0]):
                every.append(float(np.mean([*beyond.values()])))
                own_pairs += len(beyond)
        kept = whole(logs.keys()) if logs else frozenset()
        if len(kept) < len(logs):
            causes["not in every condition"] += len(logs) - len(kept)
        means = seed_means(logs)
        ratio = inference.log_ratio(means, confidence)  # NaN without pairs
        flown = [flight for (_, who), cell in groups.cells.items() if who == contestant for flight in cell]
        pooled.append(
            Statistic(
                metric=metric,
                unit=describe(metric, "results").unit,
                baseline=groups.labels[rival],
                left_out=causes_text(causes),
                conditions=len({condition for condition, _ in kept}),
                pairs=len(kept),
                units=len(means),
                own_pairs=own_pairs,
                own_reduction=_reduction(math.exp(np.mean(every))) if every else NAN,
                reduction=_reduction(ratio.value),
                reduction_low=_reduction(ratio.high),
                reduction_high=_reduction(ratio.low),
                **_whose(groups, contestant, confidence),
                **_tally(flown, trials),
                **_test(means, inference.vary(means)),
            )
        )
    tests = sum(not math.isnan(statistic.p) for statistic in pooled) or sum(statistic.pairs > 0 for statistic in pooled)
    return [replace(statistic, comparisons=tests) for statistic in corrected(pooled)]


def _logs(pairs: Sequence[tuple[Flown, Flown]]) -> dict[int, float]:
    """Seed -> logarithm of the ratio of the first metric, of the pairs that have one."""
    errors = {flown.seed: (flown.values[0], other.values[0]) for flown, other in pairs}
    return {seed: math.log(error / other) for seed, (error, other) in errors.items() if error > 0 and other > 0}


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
        return hashlib.sha256(self.csv.encode()).hexdigest()[:20]


def results_statistics(rows: Sequence[Row], *, baseline: str = BASELINE, confidence: float = CONFIDENCE) -> Statistics:
    """The statistics of result rows: of each metric, line by line and over all conditions."""
    options: dict[str, Any] = {"baseline": baseline, "confidence": confidence}
    pooled = [entry for metric in COMPARED for entry in overall(rows, metric=metric, **options)]
    return Statistics([*compute_statistics(rows, **options), *pooled], rows, baseline, confidence)


def statistics_csv(statistics: Sequence[Statistic]) -> str:
    """Numbers in full precision, nothing for NaN."""
    return csv_text(list(KINDS), ([getattr(row, name) for name in KINDS] for row in statistics))
