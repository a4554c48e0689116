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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from quadexp.report.inference import NO_RATIO, Ratio, holm, log_ratio
from quadexp.report.pairing import Common, Condition, Contestant, Groups, Row, flew_least, is_bound, seed_means
from quadexp.report.text import count, probability


def rank(
    groups: Groups, among: Common, conditions: Sequence[Condition], place: int, confidence: float
) -> tuple[Contestant | None, dict[Contestant, Ratio], float]:
    """Of those who flew in these conditions, bounds aside, by one metric over the common flights: the one with the
    least error, None without any; the ratios of all others to it, the nearest first; and p, see the module."""
    flew = dict.fromkeys(who for condition in conditions for who in groups.conditions[condition])
    ranked = [who for who in flew if who in among.compared and not is_bound(who.controller)]
    logs = dict(zip(ranked, _logs(groups, among, ranked, place), strict=True)) if ranked else {}
    if not logs or not len(logs[ranked[0]]):
        return None, {}, math.nan
    first, *others = sorted(ranked, key=lambda who: float(np.mean(logs[who])))
    ratios = {other: log_ratio(logs[other] - logs[first], confidence) for other in others}
    p = [ratio.p for ratio in ratios.values()]
    return first, ratios, min(1.0, len(ranked) * max(p)) if p and not np.isnan(p).any() else math.nan


def _logs(groups: Groups, among: Common, who: Sequence[Contestant], place: int) -> np.ndarray:
    """ln of the error of each, (who, seeds), without flights in which one of them has no error above zero."""
    logs: dict[tuple[Condition, int], np.ndarray] = {}
    for condition, seeds in among.seeds.items():
        errors = np.array([groups.values(condition, contestant, place, seeds) for contestant in who]).T
        kept = (np.isfinite(errors) & (errors > 0)).all(axis=1)
        flown = ((condition, seed) for seed in np.array(sorted(seeds))[kept].tolist())
        logs |= zip(flown, np.log(errors[kept]), strict=True)
    return seed_means(logs).reshape(-1, len(who)).T


def best_of_lines(groups: Groups, place: int, confidence: float) -> dict[tuple[Condition, Contestant], float]:
    """(condition, contestant) that may be marked as best of its line -> p that it is not, by Holm over the lines.

    Those with the smallest share of completed flights on a plant and vehicle are not marked there."""
    barred = {world: flew_least(groups.flights(conditions)) for world, conditions in groups.worlds.items()}
    p: dict[tuple[Condition, Contestant], float] = {}
    for condition, among in groups.lines.items():
        least, ratios, chance = rank(groups, among, [condition], place, confidence)
        if least is None or least in barred[condition.world] or not _flew_most(groups, least, [condition]):
            continue
        seeds = among.seeds[condition]
        means = {who: float(np.mean(groups.values(condition, who, place, seeds))) for who in (least, *ratios)}
        if means[least] <= min(means.values()):  # the table shows means, not logarithms
            p[condition, least] = chance
    return dict(zip(p, holm(np.array([*p.values()])).tolist(), strict=True))


def _flew_most(groups: Groups, who: Contestant, conditions: Sequence[Condition]) -> bool:
    flights = groups.flights(conditions)
    return all(not other.share > flights[who].share for other in flights.values())


@dataclass(frozen=True)
class Verdict:
    """The contestant with the least error of one metric on one plant and vehicle, over all conditions. All by label.

    common: number of common flights, of `units` seeds. least: "" if nobody is compared. ratios: of all other ranked
    contestants to it, the nearest first. flew_less: another one completed a larger share of its flights. bound: the
    first bound that is compared, and not ranked; the least has `bound_ratio` times its error.
    """

    confidence: float
    common: int
    units: int
    least: str
    ratios: Mapping[str, Ratio]
    p: float
    flew_less: bool
    bound: str
    bound_ratio: Ratio
    compared: Sequence[str]

    @property
    def ways(self) -> int:
        """Number of ranked contestants."""
        return len(self.ratios) + bool(self.least)

    @property
    def alike(self) -> list[str]:
        """Those that are not distinguishable from the least."""
        return [who for who, ratio in self.ratios.items() if not self.ways * ratio.p < 1 - self.confidence]

    @property
    def next(self) -> str:
        """The nearest one, of those that are alike if there are any."""
        return next(iter([*self.alike, *self.ratios]), "")

    @property
    def ratio(self) -> Ratio:
        """Of the nearest one to the least."""
        return self.ratios.get(self.next, NO_RATIO)

    @property
    def best(self) -> bool:
        """Whether `least` differs significantly from all others and no contestant flew more."""
        return self.ways > 1 and not self.alike and not self.flew_less

    def text(self) -> str:
        """Such as "least over the 20 flights that all completed: gp_mpc, the best of 3, ..."."""
        if not self.ways > 1:
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


def verdict(groups: Groups, conditions: Sequence[Condition], confidence: float) -> Verdict:
    """Over these conditions, by the first metric of the groups."""
    among, label = groups.common(conditions), groups.labels
    least, ratios, p = rank(groups, among, conditions, 0, confidence)
    bound = next((who for who in among.compared if least is not None and is_bound(who.controller)), None)
    bound_ratio = NO_RATIO
    if least is not None and bound is not None:
        logs, others = _logs(groups, among, [least, bound], 0)
        bound_ratio = log_ratio(logs - others, confidence)
    return Verdict(
        confidence=confidence,
        common=among.flights,
        units=among.units,
        least=label[least] if least else "",
        ratios={label[who]: ratio for who, ratio in ratios.items()},
        p=p,
        flew_less=least is not None and not _flew_most(groups, least, conditions),
        bound=label[bound] if bound else "",
        bound_ratio=bound_ratio,
        compared=[label[who] for who in among.compared],
    )


def verdicts(rows: Sequence[Row], *, metric: str = "mean_error", confidence: float = 0.95) -> list[Verdict]:
    """One verdict for every plant and vehicle."""
    groups = Groups(rows, "", (metric,))
    return [verdict(groups, conditions, confidence) for conditions in groups.worlds.values()]
