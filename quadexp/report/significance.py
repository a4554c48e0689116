"""Who is significantly different from whom: the one test behind every mark, p-value, "best" and "cannot tell" of a
table.

    d_ci       ln of the error of one contestant over that of another, in condition c at seed i, of the flights that
               this pair completed, whoever else did
    statement  on a pair: in a line (one condition), over the lines of a plant and vehicle, or over all lines
    d_i        mean of d_ci over the conditions of a statement, whole (pairing.py)
    p          of the d_i by sign flips; joint over all statements on the pair (inference.sign_flips)
    p_holm     of a pair with the baseline (without one, with the first who flew), by Holm over these m pairs; of any
               other pair n joint, n = max(m, k - 1) for k contestants

A pair is significantly different in a statement where p_holm < alpha. The family are all statements that a table of one
metric can make: that some contestant differs from the baseline, in any line or over all of them, is said falsely with a
probability of alpha at most. So is that one is the best of k (winner.py), which is looked for after the fact: one of k
must beat an equal or better one, and there are k that can, with a probability of alpha / (2 n) each. That bound is for
lines led by the same equals, or by at most n different pairs of equals.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from quadexp.names import distinct, named
from quadexp.report.inference import Ratio, holm, least_seeds, log_ratio, sign_flips, vary
from quadexp.report.pairing import Condition, Contestant, Groups, grouped, seed_means, whole
from quadexp.report.text import count, speed_text, too_few

Statement = tuple[Condition, ...]


@dataclass(frozen=True)
class Difference:
    """One contestant against another in a statement.

    seeds, logs: d_i, (n,). by_condition: ratio of their errors in each. flights: pairs behind it. causes: of those that
    are left out. p, joint, p_holm: see the module. comparisons: in view of how many p_holm is, times `least` is the
    least that it could have been.
    """

    seeds: np.ndarray
    logs: np.ndarray
    by_condition: Mapping[Condition, float]
    flights: int
    causes: Mapping[str, int]
    confidence: float
    p: float = math.nan
    joint: float = math.nan
    least: float = math.nan
    p_holm: float = math.nan
    comparisons: int = 0

    @cached_property
    def ratio(self) -> Ratio:
        """Of their errors."""
        return log_ratio(self.logs, self.confidence)

    @property
    def varies(self) -> bool:
        """Whether a seed changes anything."""
        return vary(self.logs)

    @property
    def apart(self) -> bool:
        return self.p_holm < 1 - self.confidence  # False for NaN

    @property
    def testable(self) -> bool:
        """Whether so many seeds can tell two apart."""
        return self.apart or self.comparisons * self.least < 1 - self.confidence  # False for NaN


class Tests:
    """The test of every pair of contestants of a table, by one metric. place: of the metric in the groups."""

    def __init__(self, groups: Groups, place: int = 0, confidence: float = 0.95) -> None:
        self.groups = groups
        self.confidence = confidence
        self._place = place
        self.metric = groups.metrics[place]
        kinds: tuple[Sequence[Statement], ...] = (
            [(condition,) for condition in groups.conditions],
            [tuple(conditions) for conditions in groups.worlds.values()],
            [tuple(groups.conditions)],
        )
        self._kinds: dict[Statement, int] = {}
        for kind, statements in enumerate(kinds):
            for statement in statements:
                self._kinds.setdefault(statement, kind)
        self._pairs: dict[tuple[Contestant, Contestant], dict[Statement, Difference]] = {}

    def difference(self, contestant: Contestant, other: Contestant, conditions: Iterable[Condition]) -> Difference:
        """Of one against other in these conditions: a line, all of a plant and vehicle, or all."""
        statement = tuple(conditions)
        difference = self._pair(contestant, other)[statement]
        pair = frozenset((contestant, other))
        if pair in self._corrected:
            times = len(self._corrected)
            p_holm = self._corrected[pair][statement]
        else:
            times = self._times
            p_holm = min(times * difference.joint, 1.0)  # NaN stays
        return replace(difference, p_holm=p_holm, comparisons=times * difference.comparisons)

    @cached_property
    def notes(self) -> list[str]:
        """What bold, *, p and "best" mean in a table, in plain words; or how many seeds it takes to say so."""
        conditions = self.groups.conditions.values()
        seeds = max((len(by_seed) for flown in conditions for by_seed in flown.values()), default=0)
        if len(self._flew) < 2:
            return []
        whole = least_seeds(self._times, self.confidence)
        line = least_seeds(self._times * len(conditions), self.confidence)
        if seeds < whole or not self._corrected:
            single = f", {line} in a single line" if seeds < whole < line else ""
            return [too_few(seeds, whole, self.confidence, ", so that nothing is bold, * or called best") + single]
        text = (
            f"bold: the least of its line, significantly different from every other there (p <"
            f" {1 - self.confidence:.2g}), by a"
            " controller that completed no fewer flights; best: the same over all lines; *: significantly different"
            " from the"
            " baseline; p: of all ways to exchange the errors of two controllers, seed by seed, on flights that both"
            " completed, the share in which they differ as clearly as flown, in view of all lines and of"
            f" {count(self._times, 'pair')} (Holm)"
        )
        notes = [text]
        if seeds < line:
            notes.append(f"{count(seeds, 'seed')}: nothing is bold or *, which takes {line} in a single line")
        return notes

    @cached_property
    def _flew(self) -> list[Contestant]:
        """The contestants that completed a flight."""
        flew = []
        for (_, who), cell in self.groups.cells.items():
            if any(flown.complete for flown in cell):
                flew.append(who)
        return distinct(flew)

    @property
    def _times(self) -> int:
        """For how many pairs a p is corrected, of a pair without the baseline."""
        return max(len(self._corrected), len(self._flew) - 1)

    @cached_property
    def _corrected(self) -> dict[frozenset[Contestant], dict[Statement, float]]:
        """The p_holm of every pair with the baseline that can be tested; without one, with the first who flew."""
        pairs = []
        for who in self.groups.contestants:
            rival = self.groups.baseline(who)
            if rival is not None:
                pairs.append((who, rival))
        if not pairs:
            pairs = [(who, self._flew[0]) for who in self._flew[1:]]
        tested = [pair for pair in pairs if any(of.varies for of in self._pair(*pair).values())]
        joint = np.array([[of.joint for of in self._pair(*pair).values()] for pair in tested])
        corrected = holm(joint).tolist()
        return {frozenset(pair): named(self._kinds, p) for pair, p in zip(tested, corrected, strict=True)}

    def _pair(self, contestant: Contestant, other: Contestant) -> dict[Statement, Difference]:
        """Every statement, without p_holm; comparisons: how many there are of its kind."""
        if (contestant, other) in self._pairs:
            return self._pairs[contestant, other]
        logs: dict[Condition, dict[int, float]] = {}
        causes: dict[Condition, Counter[str]] = {}
        for condition, flown in self.groups.conditions.items():
            if contestant in flown or other in flown:
                logs[condition], causes[condition] = self._logs(condition, contestant, other)
        of_pair = {statement: self._difference(statement, logs, causes) for statement in self._kinds}
        seeds = sorted({int(seed) for of in of_pair.values() for seed in of.seeds})
        table = np.full((len(of_pair), len(seeds)), math.nan)
        for line, of in zip(table, of_pair.values(), strict=True):
            if of.varies:
                line[np.searchsorted(seeds, of.seeds)] = of.logs
        tested = Counter(self._kinds[statement] for statement, of in of_pair.items() if of.varies)
        counts = [tested[kind] or 1 for kind in self._kinds.values()]
        for (statement, of), n, *tests in zip(of_pair.items(), counts, *sign_flips(table, counts), strict=True):
            p, joint, least = map(float, tests)
            of_pair[statement] = replace(of, p=p, joint=joint, least=least / n, comparisons=n)
        self._pairs[contestant, other] = of_pair
        return of_pair

    def _logs(
        self, condition: Condition, contestant: Contestant, other: Contestant
    ) -> tuple[dict[int, float], Counter[str]]:
        """Seed -> d_ci, and the number of other seeds by cause."""
        pairs, causes = self.groups.pairs(condition, contestant, other)
        logs = {}
        for mine, its in pairs:
            error = mine.values[self._place]
            rival = its.values[self._place]
            if 0 < error < math.inf and 0 < rival < math.inf:
                logs[mine.seed] = math.log(error / rival)
            else:
                causes["without an error above zero"] += 1
        return logs, causes

    def _difference(
        self,
        statement: Statement,
        of: Mapping[Condition, Mapping[int, float]],
        causes: Mapping[Condition, Mapping[str, int]],
    ) -> Difference:
        flights = {(at, seed): log for at in statement for seed, log in of.get(at, {}).items()}
        kept = whole(set(flights)) if flights else frozenset()
        logs = seed_means(flights)
        left_out = Counter[str]()
        for at in statement:
            left_out.update(causes.get(at, {}))
        if len(kept) < len(flights):
            left_out["with a seed that another condition lacks"] += len(flights) - len(kept)
        each = grouped((at, flights[at, seed]) for at, seed in kept)
        return Difference(
            seeds=np.array(sorted({seed for _, seed in kept}), int),
            logs=logs,
            by_condition={at: math.exp(float(np.mean(several))) for at, several in each.items()},
            flights=len(kept),
            causes=left_out,
            confidence=self.confidence,
        )


def place_texts(conditions: Collection[Condition]) -> dict[Condition, str]:
    """Such as "circle 8 m/s wind.velocity=4", with plant and vehicle where there are several."""
    worlds = {condition.world for condition in conditions}
    plants = {world[0] for world in worlds}
    vehicles = {world[1] for world in worlds}
    texts = {}
    for at in conditions:
        parts = [at.trajectory, speed_text(at.speed), at.setting]
        if len(plants) > 1:
            parts.append(at.plant)
        if len(vehicles) > 1:
            parts.append(at.vehicle)
        texts[at] = " ".join(filter(None, parts))
    return texts
