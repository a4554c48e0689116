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

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadexp.log.outcome import FAILURES
from quadexp.log.schema import describe
from quadexp.report.inference import (
    cohen_d,
    holm,
    least_p,
    least_seeds,
    log_ratio,
    mean_interval,
    paired_permutation,
    rank_biserial,
    reduction_interval,
    success_interval,
    vary,
)
from quadexp.report.metrics import SHOWN
from quadexp.report.pairing import (
    Condition,
    Contestant,
    Flights,
    Flown,
    Groups,
    Row,
    World,
    causes_text,
    seed_means,
    whole,
)  # fmt: skip
from quadexp.report.text import count, probability, too_few
from quadexp.report.winner import barred, line_p

COMPARED = tuple(dict.fromkeys((*SHOWN, "attitude_rmse")))
DESCRIBED = ("solve_time_median", "solve_time_p99", "saturated_share")  # no comparison: they are not paired by noise
BASELINE = "nominal_mpc"
CONFIDENCE = 0.95
NAN = math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistic:
    """One metric of one contestant in one condition; over all of them where plant and trajectory are "".

    mean, low, high, std, baseline_mean, difference*: in `unit`, NaN if not defined. reduction*: percent, positive if
    the contestant's mean is smaller than the baseline's over the same pairs. effect, cohen_d: of the paired
    differences, positive if smaller than the baseline.

    seeds: cells requested. trials: those that at least one contestant could fly. n: flights in the mean. common:
    flights in the common mean, 0 if it is not compared. best_p: see `winner.line_p`, corrected for the number of lines,
    NaN if it cannot be marked as best. baseline: label of the baseline, "" for none. interval: method of [low, high].
    p_least: the smallest p that so many pairs can give. comparisons: number that p_holm is corrected for. speed: m/s,
    NaN for a trajectory without one.

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
    cohen_d: float = NAN
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
    def condition(self) -> Condition:
        speed = None if math.isnan(self.speed) else self.speed
        return self.plant, self.vehicle, self.trajectory, speed, self.setting

    @property
    def contestant(self) -> Contestant:
        return self.controller, self.model, self.variant

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
        return too_few(self.units, least_seeds(max(1, self.comparisons), self.confidence), self.confidence)

    def text(self) -> str:
        """Such as "gp_mpc: 98.7 % [98.6, 98.8] less than nominal_mpc over 4 conditions (20 seeds, p < 0.0001)"."""
        if not self.pairs:
            return f"{self.label}: no pair with {self.baseline} ({self.left_out})"
        low, high = self.reduction_low, self.reduction_high
        word, (low, high) = ("less", (low, high)) if self.reduction >= 0 else ("more", (-high, -low))
        limits = "" if math.isnan(low) else f" [{low:.1f}, {high:.1f}]"
        about = self.chance + (f"; left out: {self.left_out}" if self.left_out else "")
        if self.own_pairs > self.pairs:
            own, more = abs(self.own_reduction), "less" if self.own_reduction >= 0 else "more"
            about += f"; over all {self.own_pairs} that both completed: {own:.1f} % {more}"
        over = count(self.conditions, "condition")
        return f"{self.label}: {abs(self.reduction):.1f} %{limits} {word} than {self.baseline} over {over} ({about})"


def tally(flights: Sequence[Flown], trials: int) -> dict[str, Any]:
    """How the flights of a group ended: counts by outcome, and the success rate.

    trials: see `Groups.flights`; a cell without a result (failed) is one.
    """
    outcomes = Counter(f.outcome if f.outcome in ("ok", *FAILURES) else "failed" for f in flights)
    counts = {"seeds": len(flights), "trials": trials, **{name: outcomes[name] for name in FAILURES}}
    return {**counts, "success": outcomes["ok"] / trials if trials else NAN}


def _success_limits(flights: Sequence[Flown], trials: int, confidence: float) -> dict[str, float]:
    """Of one condition, whose flights are independent; those of several are not."""
    limits = success_interval(sum(f.outcome == "ok" for f in flights), trials, confidence)
    return dict(zip(("success_low", "success_high"), limits, strict=True))


def compute_statistics(
    rows: Sequence[Row],
    *,
    metrics: Sequence[str] = (*COMPARED, *DESCRIBED),
    baseline: str = BASELINE,
    confidence: float = CONFIDENCE,
) -> list[Statistic]:
    """The statistics of result rows, metric by metric. baseline: name of a controller."""
    groups = Groups(rows, baseline, metrics)
    paired = {
        (condition, contestant): (rival, *groups.pairs(condition, contestant, rival, groups.common_in(condition)))
        for condition, contestant in groups.cells
        if (rival := groups.baseline(contestant)) is not None
    }
    flights = {condition: groups.flights([condition]) for condition in dict.fromkeys(at for at, _ in groups.cells)}
    trials = {at: flights[at[0]][at[1]].trials for at in groups.cells}
    tallies = {
        at: tally(group, trials[at]) | _success_limits(group, trials[at], confidence)
        for at, group in groups.cells.items()
    }
    least = barred(groups)
    statistics: list[Statistic] = []
    for place, metric in enumerate(metrics):
        made = []
        best = _best(groups, flights, place, confidence, least) if metric in COMPARED else {}
        for (condition, contestant), group in groups.cells.items():
            among = groups.common_in(condition)
            seeds = among.seeds.get(condition, frozenset()) if contestant in among.compared else frozenset[int]()
            values = np.array([flown.values[place] for flown in group if flown.outcome == "ok"])
            shared = groups.values(condition, contestant, place, seeds) if seeds else values[:0]
            own = _mean_fields(values, confidence)
            # The common flights are among its own: as many are the same.
            common = own if len(shared) == len(values) else _mean_fields(shared, confidence)
            fields: dict[str, Any] = {
                **dict(zip(("plant", "vehicle", "trajectory", "speed", "setting"), condition, strict=True)),
                **dict(zip(("controller", "model", "variant"), contestant, strict=True)),
                "speed": NAN if condition[3] is None else condition[3],
                **own,
                **{"common" if name == "n" else f"common_{name}": value for name, value in common.items()},
                "best_p": best.get((condition, contestant), NAN),
                **tallies[condition, contestant],
            }
            if metric in COMPARED and (condition, contestant) in paired:
                rival, pairs, left_out = paired[condition, contestant]
                fields |= {"baseline": groups.labels[rival], "left_out": causes_text(left_out)}
                fields |= _comparison(pairs, place, confidence)
            unit, label = describe(metric, "results").unit, groups.labels[contestant]
            made.append(Statistic(metric=metric, unit=unit, label=label, confidence=confidence, **fields))
        corrected = holm(np.array([one.p for one in made]))
        comparisons = int(np.count_nonzero(~np.isnan(corrected)))
        statistics += [
            one if math.isnan(p) else replace(one, p_holm=float(p), comparisons=comparisons)
            for one, p in zip(made, corrected, strict=True)
        ]
    return statistics


def _mean_fields(values: np.ndarray, confidence: float) -> dict[str, Any]:
    """Number, mean, its interval and the standard deviation of the finite values; NaN if there are none."""
    values = values[np.isfinite(values)]
    limits = mean_interval(values, confidence, least=0.0)
    return {
        "n": len(values),
        "mean": float(np.mean(values)) if len(values) else NAN,
        "low": limits.low,
        "high": limits.high,
        "std": float(np.std(values, ddof=1)) if len(values) > 1 else NAN,
        "interval": limits.method,
    }


def _best(
    groups: Groups,
    conditions: Iterable[Condition],
    place: int,
    confidence: float,
    least: Mapping[World, frozenset[Contestant]],
) -> dict[tuple[Condition, Contestant], float]:
    """(condition, contestant) -> p that it is not the best of its line, by Holm over the lines."""
    found = {at: line_p(groups, at, place, confidence, least[at[:2]]) for at in conditions}
    corrected = holm(np.array([p for _, p in found.values()]))
    return {(at, who): float(p) for (at, (who, _)), p in zip(found.items(), corrected, strict=True) if who is not None}


def _comparison(pairs: Sequence[tuple[Flown, Flown]], place: int, confidence: float) -> dict[str, Any]:
    own, others = (np.array([pair[side].values[place] for pair in pairs]) for side in (0, 1))
    if not len(pairs):
        return {}
    differences = own - others
    limits = mean_interval(differences, confidence)
    relative = reduction_interval(own, others, confidence)
    base = float(np.mean(others))
    return {
        "pairs": len(pairs),
        "baseline_mean": base,
        "difference": float(np.mean(differences)),
        "difference_low": limits.low,
        "difference_high": limits.high,
        "reduction": 100 * (1 - float(np.mean(own)) / base) if base > 0 else NAN,
        "reduction_low": relative.low,
        "reduction_high": relative.high,
        "effect": rank_biserial(differences),
        "cohen_d": cohen_d(differences),
        **_test(differences, vary(own) or vary(others)),
    }


def _test(differences: np.ndarray, varying: bool) -> dict[str, float]:
    """p of the differences of some seeds, (n,), and the least that so many can give; NaN for copies of one flight."""
    if len(differences) < 2 or not varying:
        return {"p": NAN, "p_least": NAN}
    return {"p": paired_permutation(differences), "p_least": least_p(len(differences))}


def overall(
    rows: Sequence[Row], *, metric: str = "mean_error", baseline: str = BASELINE, confidence: float = CONFIDENCE
) -> list[Statistic]:
    """Every contestant that has a baseline; see the module's equations."""
    groups = Groups(rows, baseline, (metric,))
    among = {world: groups.common(conditions) for world, conditions in groups.worlds.items()}
    flights = {condition: groups.flights([condition]) for condition in dict.fromkeys(at for at, _ in groups.cells)}
    made = []
    for contestant in groups.contestants:
        rival = groups.baseline(contestant)
        if rival is None:
            continue
        logs: dict[tuple[Condition, int], float] = {}
        every: list[list[float]] = []  # of each condition, also beyond the common flights
        causes: Counter[str] = Counter()
        own: list[Flown] = []
        trials = 0
        for condition in dict.fromkeys(at for at, who in groups.cells if who in (contestant, rival)):
            pairs, left_out = groups.pairs(condition, contestant, rival, among[condition[:2]])
            own += groups.cells.get((condition, contestant), [])
            trials += flights[condition].get(contestant, Flights(0, 0)).trials
            causes.update(left_out)
            here = _logs(pairs)
            if len(here) < len(pairs):
                causes["without an error above zero"] += len(pairs) - len(here)
            logs |= {(condition, seed): log for seed, log in here.items()}
            if found := _logs(groups.pairs(condition, contestant, rival)[0]):
                every.append([*found.values()])
        kept = whole(logs.keys()) if logs else frozenset()
        if len(kept) < len(logs):
            causes["not in every condition"] += len(logs) - len(kept)
        made.append(
            Statistic(
                metric=metric,
                unit=describe(metric, "results").unit,
                label=groups.labels[contestant],
                baseline=groups.labels[rival],
                confidence=confidence,
                left_out=causes_text(causes),
                conditions=len({condition for condition, _ in kept}),
                pairs=len(kept),
                own_pairs=sum(map(len, every)),
                own_reduction=_reduction(math.exp(np.mean([*map(np.mean, every)]))) if every else NAN,
                controller=contestant[0],
                model=contestant[1],
                variant=contestant[2],
                **tally(own, trials),
                **_over_seeds(seed_means(logs), confidence),
            )
        )
    corrected = holm(np.array([one.p for one in made]))
    tests = int(np.count_nonzero(~np.isnan(corrected))) or sum(one.pairs > 0 for one in made)
    return [replace(one, p_holm=float(p), comparisons=tests) for one, p in zip(made, corrected, strict=True)]


def _over_seeds(logs: np.ndarray, confidence: float) -> dict[str, Any]:
    """Of the logarithms of the ratio of every seed, (n,)."""
    ratio = log_ratio(logs, confidence)  # NaN without pairs
    return {
        "units": len(logs),
        "reduction": _reduction(ratio.value),
        "reduction_low": _reduction(ratio.high),
        "reduction_high": _reduction(ratio.low),
        "effect": rank_biserial(logs),
        **_test(logs, vary(logs)),
    }


def _logs(pairs: Sequence[tuple[Flown, Flown]]) -> dict[int, float]:
    """Seed -> logarithm of the ratio of the first metric, of the pairs that have one."""
    errors = {own.seed: (own.values[0], other.values[0]) for own, other in pairs}
    return {seed: math.log(own / other) for seed, (own, other) in errors.items() if own > 0 and other > 0}


def _reduction(ratio: float) -> float:
    return 100 * (1 - ratio)
