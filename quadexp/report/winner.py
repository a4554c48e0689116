"""The best contestant: the one with the least error over the common flights, if all others differ significantly.

    least      the smallest L_k = mean_i mean_c ln x_kci, over the conditions c and then over the seeds i (pairing.py)
    ratio      exp(L_j - L_least) of another to the least, paired, with its interval and p over the seeds (see
               inference.log_ratio)
    p          k max_j p_j, at most 1, for k ranked contestants; corrected by Holm over the lines of a table
    best       p < 1 - confidence = alpha, and no contestant completed a larger share of its flights

The least of k is chosen after the fact, so each p_j is multiplied by k (Bonferroni). This keeps the error rate for any
correlation: to be named falsely, one of k must beat an equal or better one, with a probability of alpha / (2 k) at
most: alpha / 2 for the verdict over all conditions, alpha / 2 for the marks in a table, alpha together. Bounds
(perfect_*, oracle_*) are not ranked.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quadexp.report.inference import NO_RATIO, Ratio, log_ratio
from quadexp.report.pairing import (
    Common,
    Condition,
    Contestant,
    Flights,
    Groups,
    Row,
    flew_least,
    is_bound,
    seed_means,
)  # fmt: skip
from quadexp.report.text import count, probability


class Ranking(NamedTuple):
    """least: with the least error. ratios: of all others to it, the nearest first. p: see the module."""

    least: Contestant | None
    ratios: dict[Contestant, Ratio]
    p: float

    def alike(self, confidence: float) -> list[Contestant]:
        """Contestants that are not distinguishable from the least."""
        ranked = len(self.ratios) + 1
        return [who for who, ratio in self.ratios.items() if not ranked * ratio.p < 1 - confidence]


def rank(groups: Groups, among: Common, who: Sequence[Contestant], place: int, confidence: float) -> Ranking:
    """The ranking of those in `who` that are compared, by one metric over the common flights."""
    who = [one for one in who if one in among.compared]
    logs = dict(zip(who, _logs(groups, among, who, place), strict=True)) if who else {}
    if not logs or not len(logs[who[0]]):
        return Ranking(None, {}, math.nan)
    first, *others = sorted(who, key=lambda one: float(np.mean(logs[one])))
    ratios = {one: log_ratio(logs[one] - logs[first], confidence) for one in others}
    p = [ratio.p for ratio in ratios.values()]
    return Ranking(first, ratios, min(1.0, len(who) * max(p)) if p and not np.isnan(p).any() else math.nan)


def _logs(groups: Groups, among: Common, who: Sequence[Contestant], place: int) -> np.ndarray:
    """ln of the error of each, (who, seeds), without flights in which one of them has no error above zero."""
    found: dict[tuple[Condition, int], np.ndarray] = {}
    for condition, seeds in among.seeds.items():
        values = np.array([groups.values(condition, one, place, seeds) for one in who]).T
        for seed, errors in zip(sorted(seeds), values, strict=True):
            if np.all(np.isfinite(errors) & (errors > 0)):
                found[condition, seed] = np.log(errors)
    return seed_means(found).reshape(-1, len(who)).T


def ratio_of(groups: Groups, among: Common, who: Contestant, other: Contestant, confidence: float) -> Ratio:
    """Error of one over that of another, of the first metric, over the common flights."""
    own, others = _logs(groups, among, [who, other], 0)
    return log_ratio(own - others, confidence)


def line_p(
    groups: Groups, condition: Condition, place: int, confidence: float, barred: Iterable[Contestant] = ()
) -> tuple[Contestant | None, float]:
    """The contestant that may be marked as best of one condition, and the p that it is not; (None, nan) for none.

    barred: those with the smallest share of completed flights on this plant and vehicle.
    """
    among = groups.common_in(condition)
    flights = groups.flights([condition])
    rivals = [one for one in flights if not is_bound(one[0])]
    ranking = rank(groups, among, rivals, place, confidence)
    least = ranking.least
    if least is None or least in {*barred} or not _flew_most(least, flights):
        return None, math.nan
    means = {
        one: float(np.mean(groups.values(condition, one, place, among.seeds[condition]))) for one in ranking.ratios
    }
    own = float(np.mean(groups.values(condition, least, place, among.seeds[condition])))
    if any(mean < own for mean in means.values()):  # the table shows means, not logarithms
        return None, math.nan
    return least, ranking.p


def _flew_most(who: Contestant, flights: dict[Contestant, Flights]) -> bool:
    return all(not one.share > flights[who].share for one in flights.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The contestant with the least error of one metric on one plant and vehicle, over all conditions.

    flown: [label, completed flights, trials] of each. compared: labels. common: number of common flights, of
    `units` seeds in `conditions` conditions. least: "" if nobody is compared. ways: number of ranked contestants.
    best: `least` differs significantly from all of them and no contestant flew more. flew_less: another one ended a
    larger share of its flights well. alike: those not distinguishable from the least. next: the nearest one, with
    `ratio` times the error. bound: the first bound; the least has `bound_ratio` times its error. Ratios: [value,
    low, high, p] or NaN.
    """

    metric: str
    plant: str
    vehicle: str
    confidence: float
    flown: list[list[Any]]
    compared: list[str]
    common: int
    conditions: int
    units: int
    least: str
    ways: int
    best: bool
    flew_less: bool
    alike: list[str]
    next: str
    ratio: list[float]
    p: float
    bound: str
    bound_ratio: list[float]

    def text(self) -> str:
        """Such as "least over the 20 flights that all completed: gp_mpc, the best of 3, ..."."""
        if not self.least or not self.ways > 1:
            return ""
        over = f"over the {count(self.common, 'flight')} that all completed"
        head = f"least {over}{', bounds aside' if self.bound else ''}: {self.least}"
        value, low, high, _ = self.ratio
        limits = "" if math.isnan(low) else f" [{low:.3g}, {high:.3g}]"
        chance = probability(self.p) or f"{count(self.units, 'seed')} cannot tell"
        ratio = f"{value:.3g} times{limits}, {chance}"
        if self.alike:
            return f"{head}, not distinguishable from {', '.join(self.alike)} (nearest: {ratio})"
        if self.flew_less:
            return f"{head}, but others completed more of their flights (nearest: {self.next}, {ratio})"
        return f"{head}, the best of {self.ways}, significantly less than the next, {self.next} ({ratio})"


def verdicts(rows: Sequence[Row], *, metric: str = "mean_error", confidence: float = 0.95) -> list[Verdict]:
    """One verdict for every plant and vehicle."""
    groups = Groups(rows, "", (metric,))
    made = []
    for (plant, vehicle), conditions in groups.worlds.items():
        about: dict[str, Any] = {"metric": metric, "plant": plant, "vehicle": vehicle, "confidence": confidence}
        made.append(_verdict(groups, groups.common(conditions), groups.flights(conditions), about))
    return made


def _verdict(groups: Groups, among: Common, flights: dict[Contestant, Flights], about: dict[str, Any]) -> Verdict:
    confidence, labels = about["confidence"], groups.labels
    rivals = [one for one in flights if not is_bound(one[0])]
    ranking = rank(groups, among, rivals, 0, confidence)
    least, alike = ranking.least, ranking.alike(confidence)
    less = least is not None and not _flew_most(least, flights)
    nearest = next(iter(alike), next(iter(ranking.ratios), None))
    bound = next((one for one in among.compared if least is not None and is_bound(one[0])), None)
    bound_ratio = ratio_of(groups, among, least, bound, confidence) if least and bound else NO_RATIO
    return Verdict(
        **about,
        flown=[[labels[one], *count] for one, count in flights.items()],
        compared=[labels[one] for one in among.compared],
        common=among.flights,
        conditions=len(among.seeds),
        units=among.units,
        least=labels[least] if least is not None else "",
        ways=len(ranking.ratios) + (least is not None),
        best=bool(ranking.ratios) and not alike and not less,
        flew_less=less,
        alike=[labels[one] for one in alike],
        next=labels[nearest] if nearest is not None else "",
        ratio=list(ranking.ratios[nearest] if nearest is not None else NO_RATIO),
        p=ranking.p,
        bound=labels[bound] if bound is not None else "",
        bound_ratio=list(bound_ratio),
    )


def barred(groups: Groups) -> dict[tuple[str, str], frozenset[Contestant]]:
    """Plant and vehicle -> those with the smallest share of completed flights."""
    return {world: flew_least(groups.flights(conditions)) for world, conditions in groups.worlds.items()}
