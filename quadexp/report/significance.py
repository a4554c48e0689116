"""Who is told apart from whom: the one test behind every mark, p-value, "best" and "cannot tell" of a table.

    d_ci       ln of the error of one contestant over that of another, in condition c at seed i, of the flights that
               this pair completed, whoever else did
    statement  on a pair: in a line (one condition), over the lines of a plant and vehicle, or over all lines
    d_i        mean of d_ci over the conditions of a statement, whole (pairing.py)
    p          of the d_i by sign flips; joint over all statements on the pair (inference.sign_flips)
    p_holm     of a pair with the baseline, by Holm over these m pairs; of any other pair n joint, n = max(m, k - 1)
               for k contestants

A pair is told apart in a statement where p_holm < alpha. The family are all statements that a table of one metric can
make: that some contestant differs from the baseline, in any line or over all of them, is said falsely with a
probability of alpha at most. So is that one is the best of k (winner.py), which is looked for after the fact: one of k
must beat an equal or better one, and there are k that can, with a probability of alpha / (2 n) each. That bound is for
lines led by the same equals, or by at most n different pairs of equals.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from quadexp.report.inference import Ratio, holm, least_p, least_seeds, log_ratio, sign_flips, vary
from quadexp.report.pairing import Condition, Contestant, Groups, grouped, seed_means, whole
from quadexp.report.text import count, speed_text, too_few

Statement = tuple[Condition, ...]


@dataclass(frozen=True)
class Difference:
    """One contestant against another in a statement.

    seeds, logs: d_i, (n,). ratio: of their errors. by_condition: the same in each. flights: pairs behind it. causes: of
    those that are left out. varies: whether seeds change anything. p, joint: see the module. comparisons: in view of
    how many p_holm is.
    """

    seeds: np.ndarray
    logs: np.ndarray
    ratio: Ratio
    by_condition: Mapping[Condition, float]
    flights: int
    causes: Mapping[str, int]
    varies: bool
    alpha: float
    p: float = math.nan
    joint: float = math.nan
    p_holm: float = math.nan
    comparisons: int = 0

    @property
    def apart(self) -> bool:
        return self.p_holm < self.alpha  # False for NaN

    @property
    def testable(self) -> bool:
        """Whether so many seeds can tell two apart."""
        return self.apart or (not math.isnan(self.p) and self.comparisons * least_p(len(self.logs)) < self.alpha)


class Tests:
    """The test of every pair of contestants of a table, by one metric. place: of the metric in the groups."""

    def __init__(self, groups: Groups, place: int = 0, confidence: float = 0.95) -> None:
        self.groups, self.confidence, self._place = groups, confidence, place
        kinds = (
            [(condition,) for condition in groups.conditions],
            [tuple(conditions) for conditions in groups.worlds.values()],
            [tuple(groups.conditions)],
        )
        self._kinds: dict[Statement, int] = {}
        for kind, statements in enumerate(kinds):
            for statement in statements:
                self._kinds.setdefault(statement, kind)
        self._pairs: dict[tuple[Contestant, Contestant], dict[Statement, Difference]] = {}

    def difference(self, one: Contestant, other: Contestant, conditions: Iterable[Condition]) -> Difference:
        """Of one against other in these conditions: a line, all of a plant and vehicle, or all."""
        statement = tuple(conditions)
        found = self._pair(one, other)[statement]
        lines = self._count(self._pair(one, other), statement)
        if (pair := frozenset((one, other))) in self._corrected:
            return replace(found, p_holm=self._corrected[pair][statement], comparisons=lines * len(self._corrected))
        return replace(found, p_holm=min(1.0, self._times * found.joint), comparisons=lines * self._times)

    @cached_property
    def notes(self) -> list[str]:
        """What bold, *, p and "best" mean in a table, in plain words; or how many seeds it takes to say so."""
        seeds = max((len(by_seed) for flown in self.groups.conditions.values() for by_seed in flown.values()), default=0)
        if len(self._flew) < 2:
            return []
        whole, line = (least_seeds(self._times * n, self.confidence) for n in (1, len(self.groups.conditions)))
        single = f", {line} in a single line" if line > whole else ""
        if seeds < whole or not self._vary:
            over = ", so that nothing is bold, * or called best"
            return [too_few(seeds, whole, self.confidence, over) + (single if seeds < whole else "")]
        text = (
            f"bold: the least of its line, told apart from every other there (p < {1 - self.confidence:.2g}), by a"
            f" controller that completed no fewer flights; best: the same over all lines;{self._star} p: of all ways to"
            " exchange the errors of two controllers, seed by seed, on the flights that both completed, the share in"
            f" which they differ as clearly as flown, in view of all lines and of {count(self._times, 'pair')} (Holm)"
        )
        return [text, *([f"{count(seeds, 'seed')}: nothing is bold or *, which takes{single[1:]}"] if seeds < line else [])]

    @property
    def _star(self) -> str:
        baselines = dict.fromkeys(self.groups.baseline(who) for who in self.groups.contestants)
        names = [self.groups.labels[who].partition(" ")[0] for who in baselines if who is not None]
        return f" *: told apart from {names[0]};" if names else ""

    @property
    def _vary(self) -> bool:
        """Whether seeds change anything for the first who flew against any other."""
        first, *others = self._flew
        return any(of.varies for who in others for of in self._pair(who, first).values())

    @cached_property
    def _flew(self) -> list[Contestant]:
        """The contestants that completed a flight."""
        flew = (who for (_, who), cell in self.groups.cells.items() if any(flown.complete for flown in cell))
        return list(dict.fromkeys(flew))

    @property
    def _times(self) -> int:
        """For how many pairs a p is corrected, of a pair without the baseline."""
        return max(len(self._corrected), len(self._flew) - 1)

    @cached_property
    def _corrected(self) -> dict[frozenset[Contestant], dict[Statement, float]]:
        """The p_holm of every pair with the baseline that can be tested."""
        pairs = [(who, rival) for who in self.groups.contestants if (rival := self.groups.baseline(who)) is not None]
        tested = [pair for pair in pairs if not all(math.isnan(of.p) for of in self._pair(*pair).values())]
        joint = np.array([[of.joint for of in self._pair(*pair).values()] for pair in tested])
        corrected = holm(joint).tolist()
        return {frozenset(pair): dict(zip(self._kinds, p, strict=True)) for pair, p in zip(tested, corrected, strict=True)}

    def _count(self, of_pair: Mapping[Statement, Difference], statement: Statement) -> int:
        """How many statements of its kind are made on a pair."""
        kind = self._kinds[statement]
        return sum(self._kinds[other] == kind and of.varies for other, of in of_pair.items()) or 1

    def _pair(self, one: Contestant, other: Contestant) -> dict[Statement, Difference]:
        if (one, other) in self._pairs:
            return self._pairs[one, other]
        logs: dict[Condition, dict[int, np.ndarray]] = {}
        causes: dict[Condition, Counter[str]] = {}
        for condition, flown in self.groups.conditions.items():
            if one in flown or other in flown:
                logs[condition], causes[condition] = self._logs(condition, one, other)
        of_pair = {statement: self._difference(statement, logs, causes) for statement in self._kinds}
        seeds = sorted({int(seed) for of in of_pair.values() for seed in of.seeds})
        table = np.full((len(of_pair), len(seeds)), math.nan)
        for line, of in zip(table, of_pair.values(), strict=True):
            if of.varies:
                line[np.searchsorted(seeds, of.seeds)] = of.logs
        counts = [self._count(of_pair, statement) for statement in of_pair]
        for statement, p, joint in zip(list(of_pair), *sign_flips(table, counts), strict=True):
            of_pair[statement] = replace(of_pair[statement], p=float(p), joint=float(joint))
        self._pairs[one, other] = of_pair
        return of_pair

    def _logs(
        self, condition: Condition, one: Contestant, other: Contestant
    ) -> tuple[dict[int, np.ndarray], Counter[str]]:
        """Seed -> ln of the errors of both, (2,), and the number of other seeds by cause."""
        pairs, causes = self.groups.pairs(condition, one, other)
        logs = {}
        for mine, its in pairs:
            errors = np.array([mine.values[self._place], its.values[self._place]])
            if np.isfinite(errors).all() and errors.min() > 0:
                logs[mine.seed] = np.log(errors)
            else:
                causes["without an error above zero"] += 1
        return logs, causes

    def _difference(
        self,
        statement: Statement,
        logs: Mapping[Condition, Mapping[int, np.ndarray]],
        causes: Mapping[Condition, Mapping[str, int]],
    ) -> Difference:
        flights = {(at, seed): both for at in statement for seed, both in logs.get(at, {}).items()}
        kept = whole(flights) if flights else frozenset()
        means = seed_means(flights).reshape(-1, 2)
        left_out = Counter[str]()
        for at in statement:
            left_out.update(causes.get(at, {}))
        if len(kept) < len(flights):
            left_out["not in every condition"] += len(flights) - len(kept)
        each = grouped((at, flights[at, seed]) for at, seed in kept)
        apart = {at: np.mean(several, axis=0) for at, several in each.items()}
        return Difference(
            seeds=np.array(sorted({seed for _, seed in kept}), int),
            logs=means[:, 0] - means[:, 1],
            ratio=log_ratio(means[:, 0] - means[:, 1], self.confidence),
            by_condition={at: math.exp(own - its) for at, (own, its) in apart.items()},
            flights=len(kept),
            causes=left_out,
            varies=vary(means[:, 0]) or vary(means[:, 1]),
            alpha=1 - self.confidence,
        )


def place_texts(conditions: Collection[Condition]) -> dict[Condition, str]:
    """Such as "circle 8 m/s wind.velocity=4", with plant and vehicle where there are several."""
    texts = {}
    for at in conditions:
        parts = [at.trajectory, speed_text(at.speed), at.setting]
        parts += [at.plant] * (len({other.plant for other in conditions}) > 1)
        parts += [at.vehicle] * (len({other.vehicle for other in conditions}) > 1)
        texts[at] = " ".join(filter(None, parts))
    return texts
