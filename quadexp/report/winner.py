"""Who is best, if anybody: the least error over the common flights, told apart from everybody else's.

    least      the smallest L_k = mean_c mean_i ln x_kci over the common flights i of the conditions c (see common.py)
    ratio      exp(L_j - L_least) of another to the least, paired, with its interval and p (see inference.log_ratio)
    p          k max_j p_j, at most 1, for k that are ranked; corrected by Holm over the lines of a table
    best       p < 1 - confidence = alpha, and nobody ended a larger share of the flights well

The least of k was chosen for being the least, so each p_j is multiplied by k. That holds the error rate whatever the
correlation: to name one falsely it must beat a truly equal or better one from the wrong side, which has a probability
of alpha / (2 k) at most, and there are k of them (Bonferroni): alpha / 2 for the verdict over all conditions and
alpha / 2 for the marks in a table, alpha together. Bounds (perfect_*, oracle_*) are not ranked.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from quadexp.report.common import Flights, flew_least
from quadexp.report.inference import Ratio, log_ratio
from quadexp.report.pairing import Common, Condition, Contestant, Groups, Row, is_bound

NO_RATIO = Ratio(math.nan, math.nan, math.nan, math.nan)


class Ranking(NamedTuple):
    """least: who has the least error. ratios: of everybody else to it, the nearest first. p: see the module."""

    least: Contestant | None
    ratios: dict[Contestant, Ratio]
    p: float

    def alike(self, confidence: float) -> list[Contestant]:
        """Who is not distinguishable from the least."""
        count = len(self.ratios) + 1
        return [who for who, ratio in self.ratios.items() if not count * ratio.p < 1 - confidence]


def rank(groups: Groups, among: Common, who: Sequence[Contestant], place: int, confidence: float) -> Ranking:
    """The ranking of those of `who` that are compared, by one metric over their common flights."""
    logs = _logs(groups, among, [one for one in who if one in among.compared], place)
    means = {one: float(np.mean([np.mean(log) for log in found])) for one, found in logs.items() if found}
    if not means:
        return Ranking(None, {}, math.nan)
    first, *others = sorted(means, key=lambda one: means[one])
    ratios = {one: _ratio(logs[one], logs[first], confidence) for one in others}
    p = [ratio.p for ratio in ratios.values()]
    return Ranking(first, ratios, min(1.0, len(means) * max(p)) if p and not np.isnan(p).any() else math.nan)


def _logs(groups: Groups, among: Common, who: Sequence[Contestant], place: int) -> dict[Contestant, list[np.ndarray]]:
    """ln of the errors of each by condition; flights in which somebody has no error above zero take no part."""
    found: dict[Contestant, list[np.ndarray]] = {one: [] for one in who}
    if not who:
        return found
    for condition, seeds in among.seeds.items():
        values = np.array([groups.values(condition, one, place, seeds) for one in who])
        values = values[:, np.all(np.isfinite(values) & (values > 0), axis=0)]
        if values.shape[1]:
            for one, own in zip(who, values, strict=True):
                found[one].append(np.log(own))
    return found


def _ratio(values: Sequence[np.ndarray], others: Sequence[np.ndarray], confidence: float) -> Ratio:
    return log_ratio([a - b for a, b in zip(values, others, strict=True)], confidence, across=True)


def ratio_of(groups: Groups, among: Common, who: Contestant, other: Contestant, confidence: float) -> Ratio:
    """Error of one over that of another, of the first metric, over the common flights."""
    logs = _logs(groups, among, [who, other], 0)
    return _ratio(logs[who], logs[other], confidence)


def line_p(
    groups: Groups, condition: Condition, place: int, confidence: float, barred: Iterable[Contestant] = ()
) -> tuple[Contestant | None, float]:
    """Who may be marked as the best of one condition, and the p that it is not; (None, nan) where nobody may.

    barred: who flew least of all on this plant and vehicle.
    """
    among = groups.common_in(condition)
    if among.flights < 2:
        return None, math.nan
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
    if any(mean < own for mean in means.values()):  # least in the logarithm, not in the mean that the table shows
        return None, math.nan
    return least, ranking.p


def _flew_most(who: Contestant, flights: dict[Contestant, Flights]) -> bool:
    return all(not one.share > flights[who].share for one in flights.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Who has the least error of one metric on one plant and vehicle, over all conditions, and how sure that is.

    flown: [label, flights that ended well, trials] of each. compared: labels. common: flights that all of them ended
    well, in `conditions` conditions. least: "" where nobody is compared. ways: how many rivals were ranked. best:
    `least` is told apart from all of them and nobody flew more. flew_less: somebody ended a larger share of its flights
    well. alike: rivals that are not distinguishable from the least. next: the nearest rival, at `ratio` times the
    error. bound: the first bound; the least has `bound_ratio` times its error. Ratios: [value, low, high, p], NaN where
    there is none.
    """

    metric: str
    plant: str
    vehicle: str
    confidence: float
    flown: list[list[Any]]
    compared: list[str]
    common: int
    conditions: int
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
        """Such as "least over the 20 flights that all ended well: gp_mpc, told apart from ..."."""
        if not self.least or not self.ways > 1:
            return ""
        over = f"over the {self.common} flight{'s' if self.common != 1 else ''} that all ended well"
        head = f"least {over}{', bounds aside' if self.bound else ''}: {self.least}"
        ratio = f"{ratio_text(self.ratio)}, {p_text(self.p)}"
        if self.alike:
            return f"{head}, not distinguishable from {', '.join(self.alike)} (nearest: {ratio})"
        if self.flew_less:
            return f"{head}, but others ended more of their flights well (nearest: {self.next}, {ratio})"
        return f"{head}, the best of {self.ways}, told apart from the next, {self.next} ({ratio})"


def ratio_text(ratio: Sequence[float]) -> str:
    """Such as "1.05 times [1.01, 1.09]"."""
    value, low, high, _ = ratio
    limits = "" if math.isnan(low) else f" [{low:.3g}, {high:.3g}]"
    return f"{value:.3g} times{limits}"


def p_text(p: float) -> str:
    return "too few flights to tell" if math.isnan(p) else "p < 0.0001" if p < 1e-4 else f"p = {p:.2g}"


def verdicts(
    rows: Sequence[Row], *, metric: str = "mean_error", confidence: float = 0.95, groups: Groups | None = None
) -> list[Verdict]:
    """One verdict for every plant and vehicle. groups: of these rows and this metric alone, where there are some."""
    groups = groups or Groups(rows, "", (metric,))
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
    bound, bound_ratio = None, NO_RATIO
    if least is not None:
        bound = next((one for one in among.compared if is_bound(one[0])), None)
    if least is not None and bound is not None:
        bound_ratio = ratio_of(groups, among, least, bound, confidence)
    return Verdict(
        **about,
        flown=[[labels[one], *count] for one, count in flights.items()],
        compared=[labels[one] for one in among.compared],
        common=among.flights,
        conditions=len(among.seeds),
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
    """Plant and vehicle -> who flew least there."""
    return {world: flew_least(groups.flights(conditions)) for world, conditions in groups.worlds.items()}
