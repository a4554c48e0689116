"""The best contestant: the one with the least error, if it is significantly different from every other one.

    least      of the ranked contestants, who has less error than every other on the flights that these two completed,
               ln x averaged over the conditions and then over the seeds
    best       significantly different from every other (significance.py), and no contestant completed a larger share of
    its flights

A contestant that completed fewer flights than the least, so few that no test is possible, does not stand in the way
where it has more error on those that both completed, or none. Bounds (perfect_*, oracle_*) are not ranked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from quadexp.report.metrics import metric_of
from quadexp.report.pairing import Condition, Contestant, Flights, Groups, flew_least, is_bound
from quadexp.report.significance import Difference, Tests, place_texts
from quadexp.report.text import count, listed, probability


def rank(
    tests: Tests, conditions: Sequence[Condition]
) -> tuple[Contestant | None, dict[Contestant, Difference], dict[Contestant, Flights]]:
    """Of those who completed a flight in these conditions, oracles aside: the one with the least error, None without
    any; all others against it, the nearest first; and how many flights each of all completed."""
    flights = tests.groups.flights(conditions)
    ranked = [who for who, flown in flights.items() if flown.ended and not is_bound(who.controller)]
    if not ranked or metric_of(tests.metric).more_is_better:
        return None, {}, flights
    least, *others = sorted(ranked, key=lambda who: -flights[who].share)
    for other in others:
        if tests.difference(other, least, conditions).ratio.value < 1:
            least = other
    against = {who: tests.difference(who, least, conditions) for who in ranked if who != least}
    nearest = sorted(against.items(), key=lambda item: (math.isnan(item[1].ratio.value), item[1].ratio.value))
    return least, dict(nearest), flights


def is_behind(difference: Difference, flights: Flights, of_least: Flights) -> bool:
    """Whether a contestant does not stand in the way of the least being called best; see the module."""
    less = difference.ratio.value < 1
    if difference.testable or not flights.share < of_least.share:
        return difference.apart and not less
    return not less


def best_of_lines(tests: Tests, place: int) -> dict[tuple[Condition, Contestant], float]:
    """(condition, contestant) that is the best of its line -> the largest p that it is not.

    Those with the smallest share of completed flights on a plant and vehicle are not marked there."""
    groups = tests.groups
    barred = {world: flew_least(groups.flights(conditions)) for world, conditions in groups.worlds.items()}
    best: dict[tuple[Condition, Contestant], float] = {}
    for condition in groups.conditions:
        least, against, flights = rank(tests, [condition])
        if least is None or not against or least in barred[condition.world] or not _flew_most(least, flights):
            continue
        tested = [of.p_holm for of in against.values() if of.testable]
        behind = (is_behind(of, flights[who], flights[least]) for who, of in against.items())
        if tested and all(behind) and _has_least_mean(groups, condition, least, against, place):
            best[condition, least] = max(tested)
    return best


def _has_least_mean(
    groups: Groups, condition: Condition, least: Contestant, others: Mapping[Contestant, Difference], place: int
) -> bool:
    """Whether the mean itself, which a table shows, is the least too, on the flights of each pair."""
    for other, difference in others.items():
        seeds = frozenset(difference.seeds.tolist())
        errors = groups.values(condition, least, place, seeds)
        its = groups.values(condition, other, place, seeds)
        if len(errors) and not np.mean(errors) <= np.mean(its):
            return False
    return True


def _flew_most(who: Contestant, flights: Mapping[Contestant, Flights]) -> bool:
    return all(not other.share > flights[who].share for other in flights.values())


@dataclass(frozen=True)
class Verdict:
    """The contestant with the least error of one metric on one plant and vehicle, over all conditions. All by label.

    where: the plant and vehicle, "" where there is one only. common: number of common flights. least: "" if nobody is
    compared. against: all other ranked contestants against it, the nearest first. alike: those that are not
    significantly different from it. aside: those that completed too few flights for a test. flew_less: another one
    completed a larger share of its flights. bound: the first bound that flew, which is not ranked; the least against
    it. compared: by their means.
    """

    where: str
    common: int
    least: str
    against: Mapping[str, Difference]
    alike: Sequence[str]
    aside: Sequence[str]
    flew_less: bool
    bound: str
    of_bound: Difference | None
    compared: Sequence[str]

    @property
    def ways(self) -> int:
        """Number of ranked contestants that can be compared."""
        return len(self.against) + bool(self.least) - len(self.aside)

    @property
    def next(self) -> str:
        """The nearest one, of those that are alike if there are any."""
        return next(iter([*self.alike, *(who for who in self.against if who not in self.aside)]), self.least)

    @property
    def best(self) -> bool:
        """Whether `least` is significantly different from all others and no contestant flew more."""
        return self.ways > 1 and not self.alike and not self.flew_less

    def text(self) -> str:
        """Such as "least over the 20 flights that all completed: perfect_mpc, the best of 3, ..."."""
        if not self.against:
            return ""
        flights = sorted({difference.flights for difference in self.against.values()})
        over = f"the {count(flights[-1], 'flight')} that all completed"
        if len(flights) > 1:
            over = f"the {flights[0]} to {flights[-1]} flights that it and each other completed"
        bound = ", oracles aside" if self.bound else ""
        head = f"least over {over}{f' in {self.where}' if self.where else ''}{bound}: {self.least}"
        if self.aside:
            head += f" ({listed(self.aside)} aside: too few flights completed for a test)"
        head += self._elsewhere()
        if self.next == self.least:
            return head
        nearest = self.against[self.next]
        value, low, high = nearest.ratio
        limits = "" if math.isnan(low) else f" [{low:.3g}, {high:.3g}]"
        seeds = count(len(nearest.seeds), "seed")
        chance = probability(nearest.p_holm) if nearest.testable else f"{seeds}, too few for a test"
        ratio = f"{value:.3g} times{limits}, {chance}"
        if self.flew_less:
            return f"{head}, but others completed more of their flights (nearest: {self.next}, {ratio})"
        if self.alike and not nearest.testable:
            return f"{head}; next: {self.next}, {ratio}"
        if self.alike:
            return f"{head}, not distinguishable from {', '.join(self.alike)} (nearest: {ratio})"
        return f"{head}, the best of {self.ways}, significantly less than the next, {self.next} ({ratio})"

    def _elsewhere(self) -> str:
        """In how many conditions another one has less error, and where it is the most."""
        ratios = {(who, at): x for who, of in self.against.items() for at, x in of.by_condition.items() if x < 1}
        if not ratios:
            return ""
        who, at = min(ratios, key=ratios.__getitem__)
        every = {place for of in self.against.values() for place in of.by_condition}
        less = len({place for _, place in ratios})
        most = f"{who}: {ratios[who, at]:.3g} times in {place_texts(every)[at]}"
        return f", less by others in {less} of {count(len(every), 'condition')} ({most})"


def verdict(tests: Tests, conditions: Sequence[Condition]) -> Verdict:
    """Over these conditions, of one plant and vehicle."""
    groups = tests.groups
    label = tests.groups.labels
    least, against, flights = rank(tests, conditions)
    among = groups.common(conditions)
    bound = next((who for who, flown in flights.items() if least and flown.ended and is_bound(who.controller)), None)
    behind = {who: least and is_behind(of, flights[who], flights[least]) for who, of in against.items()}
    return Verdict(
        where=" ".join(conditions[0].world) if len(groups.worlds) > 1 else "",
        common=among.flights,
        least=label[least] if least else "",
        against={label[who]: difference for who, difference in against.items()},
        alike=[label[who] for who in against if not behind[who]],
        aside=[label[who] for who, of in against.items() if behind[who] and not of.testable],
        flew_less=least is not None and not _flew_most(least, flights),
        bound=label[bound] if bound else "",
        of_bound=tests.difference(least, bound, conditions) if least and bound else None,
        compared=[label[who] for who in among.compared],
    )
