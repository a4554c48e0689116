"""Statistics of a comparison: one row per metric, condition and contestant, over the seeds.

The mean is over the flights that ended well; those that did not are counted beside it, by outcome, and lower the
success rate. A contestant is compared with the baseline seed by seed, difference = contestant - baseline, over the
seeds on which both ended well; the others are counted in `left_out`, by cause. p-values are corrected for all
comparisons of one metric. The equations stand in inference.py, conditions and pairs in pairing.py.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadexp.flight.schema import describe
from quadexp.report.inference import (
    cohen_d,
    holm,
    least_p,
    mean_interval,
    paired_permutation,
    rank_biserial,
    reduction_interval,
    success_interval,
)
from quadexp.report.metrics import SHOWN
from quadexp.report.pairing import Condition, Contestant, Flown, Groups, Row, said

COMPARED = tuple(dict.fromkeys((*SHOWN, "attitude_rmse")))
DESCRIBED = ("solve_time_median", "solve_time_p99", "saturated_share")  # no comparison: they are not paired by noise
BASELINE = "nominal_mpc"
CONFIDENCE = 0.95
FAILURES = ("lost", "solver_failed", "infeasible", "failed")
NAN = math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistic:
    """One metric of one contestant in one condition.

    mean, low, high, std, baseline_mean, difference*: in `unit`, NaN where not defined. reduction*: percent, positive
    where the contestant's mean is smaller than the baseline's over the same pairs. effect, cohen_d: of the paired
    differences, positive where smaller than the baseline.

    seeds: cells asked for. n: flights in the mean. baseline: label of whom it is compared with, "" for nobody.
    interval: how [low, high] came about. p_least: the least p that so many pairs can give. comparisons: over how many
    p_holm is corrected. speed: m/s, NaN where the trajectory has none.
    """

    metric: str
    unit: str
    plant: str
    vehicle: str
    trajectory: str
    speed: float
    setting: str
    controller: str
    model: str
    variant: str
    label: str
    confidence: float
    seeds: int
    n: int
    mean: float
    low: float
    high: float
    std: float
    interval: str
    lost: int
    solver_failed: int
    infeasible: int
    failed: int
    success: float
    success_low: float
    success_high: float
    baseline: str = ""
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

    @property
    def condition(self) -> Condition:
        speed = None if math.isnan(self.speed) else self.speed
        return self.plant, self.vehicle, self.trajectory, speed, self.setting

    @property
    def contestant(self) -> Contestant:
        return self.controller, self.model, self.variant

    @property
    def failures(self) -> dict[str, int]:
        """Outcome -> count, of the flights that did not end well."""
        return {name: count for name in FAILURES if (count := getattr(self, name))}

    @property
    def significant(self) -> bool:
        return self.p_holm < 1 - self.confidence  # False for NaN


def tally(flights: Sequence[Flown], confidence: float) -> dict[str, Any]:
    """How the flights of a group ended: counts by outcome, and the success rate with its interval.

    A reference that nobody can fly (infeasible) is no trial; a cell without a result (failed) is one, and no success.
    """
    outcomes = Counter(f.outcome if f.outcome in ("ok", *FAILURES) else "failed" for f in flights)
    trials = len(flights) - outcomes["infeasible"]
    low, high = success_interval(outcomes["ok"], trials, confidence)
    success = outcomes["ok"] / trials if trials else NAN
    counts = {name: outcomes[name] for name in FAILURES}
    return {"seeds": len(flights), **counts, "success": success, "success_low": low, "success_high": high}


def compute_statistics(
    rows: Sequence[Row],
    *,
    metrics: Sequence[str] = (*COMPARED, *DESCRIBED),
    baseline: str = BASELINE,
    confidence: float = CONFIDENCE,
    seed: int = 0,
) -> list[Statistic]:
    """The statistics of result rows, metric by metric. baseline: name of a controller. seed: of the bootstrap."""
    groups = Groups(rows, baseline, metrics)
    paired = {
        (condition, contestant): (rival, *groups.pairs(condition, contestant, rival))
        for condition, contestant in groups.cells
        if (rival := groups.baseline(contestant)) is not None
    }
    tallies = {at: tally(group, confidence) for at, group in groups.cells.items()}
    statistics: list[Statistic] = []
    for place, metric in enumerate(metrics):
        made = []
        for (condition, contestant), group in groups.cells.items():
            values = np.array([flown.values[place] for flown in group if flown.outcome == "ok"])
            values = values[np.isfinite(values)]
            limits = mean_interval(values, confidence, least=0.0, seed=seed)
            fields: dict[str, Any] = {
                **dict(zip(("plant", "vehicle", "trajectory", "speed", "setting"), condition, strict=True)),
                **dict(zip(("controller", "model", "variant"), contestant, strict=True)),
                "speed": NAN if condition[3] is None else condition[3],
                "n": len(values),
                "mean": float(np.mean(values)) if len(values) else NAN,
                "std": float(np.std(values, ddof=1)) if len(values) > 1 else NAN,
                **tallies[condition, contestant],
            }
            if metric in COMPARED and (condition, contestant) in paired:
                rival, pairs, left_out = paired[condition, contestant]
                fields |= {"baseline": groups.labels[rival], "left_out": said(left_out)}
                fields |= _comparison(pairs, place, confidence, seed)
            made.append(
                Statistic(
                    metric=metric,
                    unit=describe(metric, "results").unit,
                    label=groups.labels[contestant],
                    confidence=confidence,
                    low=limits.low,
                    high=limits.high,
                    interval=limits.method,
                    **fields,
                )
            )
        statistics += _corrected(made)
    return statistics


def _comparison(pairs: Sequence[tuple[Flown, Flown]], place: int, confidence: float, seed: int) -> dict[str, Any]:
    own, others = (np.array([pair[side].values[place] for pair in pairs]) for side in (0, 1))
    if not len(pairs):
        return {}
    differences = own - others
    limits = mean_interval(differences, confidence, seed=seed)
    relative = reduction_interval(own, others, confidence, seed=seed)
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
        "p": paired_permutation(differences, seed=seed) if len(pairs) > 1 else NAN,
        "p_least": least_p(len(pairs)) if len(pairs) > 1 else NAN,
    }


def _corrected(statistics: Sequence[Statistic]) -> list[Statistic]:
    """The same with p corrected for the number of comparisons among them."""
    p = np.array([statistic.p for statistic in statistics])
    count = int(np.count_nonzero(~np.isnan(p)))
    return [
        replace(statistic, p_holm=float(value), comparisons=count)
        if count and not math.isnan(statistic.p)
        else statistic
        for statistic, value in zip(statistics, holm(p), strict=True)
    ]
