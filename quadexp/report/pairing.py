"""Which flights are compared: the one rule of every table, statistic, figure and sentence on several controllers.

    condition   what was flown: plant, vehicle, trajectory, speed and any other setting that varies within the sweep
    contestant  who flew it: controller, checkpoint and the controller's own settings
    trial       a flight that was requested and that at least one contestant could fly (was not infeasible for all)
    invalid     a combination of settings that contradict each other: no flight was requested, it takes no part
    flown       "k of n": of n trials, k completed
    compared    contestants with k > 0
    common      the flights (condition, seed) that all compared contestants completed, made whole; as long as there are
                none, the contestants with the smallest k are removed from the comparison
    pair        two flights of one condition and seed, which both completed, whoever else did: they have the same noise
    unit        a seed. Conditions that differ only in the world, the grid of a controller or a compensation share every
    gust
                of a seed, so that their flights are no sample: the value of a seed is its mean over the conditions, and
                intervals, p and counts are over the seeds. So they are for conditions with noise of their own (another
                path, speed, plant or vehicle), whose mean is then less uncertain; these are chosen, not drawn: one seed
                on twelve paths is one value, without an interval
    whole       every condition with every seed: otherwise the seeds are means of different conditions. Of flights that
                are not, the condition or the seed that lacks the largest share of them is left out, until they are: a
                condition with two common flights decides nothing

Means that stand beside each other are over the common flights, so they are of the same paths and noise, with the mean
over all own flights and its count beside them. What is said of two contestants (difference, ratio, test, best) is over
the pairs of these two (significance.py): a third one that loses flights takes nothing from them. The contestants with
the smallest share of completed flights are never marked as best.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence, Set
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple, TypeVar

import numpy as np

from quadexp.names import distinct
from quadexp.parts.schema import CHOSEN, of_contestant

Who = TypeVar("Who", bound=Hashable)
What = TypeVar("What", bound=Hashable)
Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")
Label = TypeVar("Label", bound=tuple[str, ...])
Row = Mapping[str, Any]
Rows = Sequence[Row]
World = tuple[str, str]  # plant, vehicle
BASELINE = "nominal_mpc"
BOUNDS = ("perfect_", "oracle_")  # controllers that know the true plant: they are not ranked

SOURCE = "results"  # key of the folder that a flight of several results comes from
_BEFORE_KEY = re.compile(
    rf" (?=(?:{'|'.join((*CHOSEN, 'evaluate', SOURCE))})(?:\.[\w./@]+)?=)"
)  # values may hold " a=b"
_KEYS_ABOVE = re.compile(r"^[^=]*\.(?=[^=.]*=)")


def _split(variant: str | None) -> list[str]:
    """ "controller.nodes=20 plant.lift=0.1" as its settings."""
    return _BEFORE_KEY.split(variant) if variant else []


def grouped(pairs: Iterable[tuple[Key, Value]]) -> dict[Key, list[Value]]:
    """Key -> its values, both in order of appearance."""
    groups: dict[Key, list[Value]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


class Condition(NamedTuple):
    """What is flown. speed: m/s, None for a trajectory without one. setting: every other one that varies."""

    plant: str
    vehicle: str
    trajectory: str
    speed: float | None
    setting: str

    @property
    def world(self) -> World:
        return self.plant, self.vehicle


class Contestant(NamedTuple):
    """Who flies it. model: the checkpoint. settings: of the controller."""

    controller: str
    model: str
    settings: str


def condition_of(row: Row) -> Condition:
    speed = row["speed"]
    if speed is not None:
        speed = None if math.isnan(float(speed)) else float(speed)
    return Condition(row["plant"], row["vehicle"], row["trajectory"], speed, _settings(row, of_who=False))


def contestant_of(row: Row) -> Contestant:
    return Contestant(row["controller"], row["model"], _settings(row, of_who=True))


def _settings(row: Row, *, of_who: bool) -> str:
    """The settings of a row that belong to the contestant, or those of the condition."""
    settings = []
    for part in _split(row.get("variant")):
        key = part.partition("=")[0]
        if of_contestant(key) == of_who:
            settings.append(part)
    return " ".join(settings)


def is_flown(row: Row) -> bool:
    """Whether a flight completed."""
    return bool(row["outcome"] == "ok")


def is_invalid(row: Row) -> bool:
    """Whether the settings of a row contradict each other, so that there was nothing to fly."""
    return bool(row["outcome"] == "invalid")


def is_bound(controller: str) -> bool:
    return controller.startswith(BOUNDS)


def contestant_labels(contestants: Sequence[Contestant]) -> dict[Contestant, str]:
    """The controller's name, with checkpoint and settings as far as they distinguish it from the others."""
    models = grouped(distinct(who[:2] for who in contestants))
    paths = {who.model for who in contestants}
    short = {path: path.rstrip("/").rpartition("/")[2] for path in paths}
    if len(set(short.values())) < len(paths):  # two checkpoints of one name: the whole path
        short = {path: path for path in paths}
    labels = {}
    for who in contestants:
        parts = [who.controller]
        if len(models[who.controller]) > 1:
            parts.append(short[who.model])
        parts += [_KEYS_ABOVE.sub("", part) for part in _split(who.settings)]  # "nodes=20" of "controller.nodes=20"
        labels[who] = " ".join(filter(None, parts))
    return unambiguous(labels)


def unambiguous(labels: Mapping[Label, str]) -> dict[Label, str]:
    """The labels; of those that are the same, all that they stand for."""
    count = Counter(labels.values())
    return {what: " ".join(filter(None, what)) if count[label] > 1 else label for what, label in labels.items()}


def setting_pairs(variant: str | None) -> list[tuple[str, str]]:
    """(key, value) of the settings of a variant, as texts; values may hold blanks."""
    pairs = []
    for part in _split(variant):
        key, _, value = part.partition("=")
        pairs.append((key, value))
    return pairs


class Flights(NamedTuple):
    """How many flights were completed, of how many trials."""

    ended: int
    trials: int

    @property
    def share(self) -> float:
        return self.ended / self.trials if self.trials else math.nan

    def text(self) -> str:
        return f"{self.ended} of {self.trials}"

    def plus(self, other: Flights) -> Flights:
        return Flights(self.ended + other.ended, self.trials + other.trials)


def common(ended: Mapping[Who, Set[tuple[What, int]]]) -> tuple[list[Who], frozenset[tuple[What, int]]]:
    """Who is compared, and the whole flights that all of them completed; nobody if there are no common flights.

    ended: who -> flights (condition, seed) that completed.
    """
    compared = [who for who, flights in ended.items() if flights]
    while compared:
        shared = frozenset[tuple[What, int]].intersection(*(frozenset(ended[who]) for who in compared))
        if shared:
            return compared, whole(shared)
        least = min(len(ended[who]) for who in compared)
        compared = [who for who in compared if len(ended[who]) > least]
    return [], frozenset()


def whole(flights: Set[tuple[What, int]]) -> frozenset[tuple[What, int]]:
    """Those of some flights (condition, seed), of which every condition has every seed; see the module."""
    conditions = sorted({at for at, _ in flights}, key=str)
    seeds = sorted({seed for _, seed in flights})
    there = np.array([[(at, seed) in flights for seed in seeds] for at in conditions])
    while not there.all():
        by_condition = there.mean(axis=1)
        by_seed = there.mean(axis=0)
        if by_seed.min() < by_condition.min():
            place = int(by_seed.argmin())
            there = np.delete(there, place, axis=1)
            del seeds[place]
        else:
            place = int(by_condition.argmin())
            there = np.delete(there, place, axis=0)
            del conditions[place]
    return frozenset(product(conditions, seeds))


def seed_means(values: Mapping[tuple[What, int], Any]) -> np.ndarray:
    """The independent values of a comparison: the mean of each seed over the conditions, (seeds, ...), seeds ascending.

    values: (condition, seed) -> (...); those that are not whole are left out."""
    kept = sorted(whole(values.keys()), key=str) if values else []
    by_seed = grouped((seed, values[at, seed]) for at, seed in kept)
    each = (by_seed[seed] for seed in sorted(by_seed))
    return np.array([values[0] if len(values) == 1 else np.mean(values, axis=0) for values in each])


def flew_least(flights: Mapping[Who, Flights]) -> frozenset[Who]:
    """The contestants with the smallest share of completed flights; none if all have the same."""
    shares = {who: count.share for who, count in flights.items() if count.trials}
    low = min(shares.values(), default=0.0)
    high = max(shares.values(), default=0.0)
    return frozenset(who for who, share in shares.items() if share == low < high)


class Flown(NamedTuple):
    """One flight as statistics need it. values: of the metrics, in the requested order."""

    seed: int
    outcome: str
    values: tuple[float, ...]

    @property
    def complete(self) -> bool:
        """Whether it has an error to compare."""
        return self.outcome == "ok" and math.isfinite(self.values[0])


class Common(NamedTuple):
    """Who is compared, and condition -> seeds of the common flights, for all conditions the same."""

    compared: tuple[Contestant, ...]
    seeds: Mapping[Condition, frozenset[int]]

    @property
    def flights(self) -> int:
        return sum(map(len, self.seeds.values()))

    @property
    def units(self) -> int:
        """Number of seeds."""
        return max(map(len, self.seeds.values()), default=0)


class Groups:
    """The flights of a comparison, in order of first appearance.

    cells: (condition, contestant) -> flights. conditions: condition -> contestant -> seed, ascending -> flights (two of
    a seed where a table was joined from two sweeps). worlds: plant and vehicle -> their conditions. labels: of the
    contestants; None: that tell these apart.
    """

    def __init__(
        self, rows: Sequence[Row], baseline: str, metrics: Sequence[str], labels: Mapping[Contestant, str] | None = None
    ) -> None:

        def flown(row: Row) -> Flown:
            return Flown(int(row["seed"]), str(row["outcome"]), tuple(float(row[metric]) for metric in metrics))

        self.metrics = tuple(metrics)
        valid = (row for row in rows if not is_invalid(row))
        self.cells = grouped(((condition_of(row), contestant_of(row)), flown(row)) for row in valid)
        self.conditions: dict[Condition, dict[Contestant, dict[int, list[Flown]]]] = {}
        for (condition, contestant), flights in self.cells.items():
            by_seed = grouped((flight.seed, flight) for flight in sorted(flights, key=lambda flight: flight.seed))
            self.conditions.setdefault(condition, {})[contestant] = by_seed
        self.worlds = grouped((condition.world, condition) for condition in self.conditions)
        self.contestants = distinct(contestant for _, contestant in self.cells)
        self.labels = labels or contestant_labels(self.contestants)
        self._baselines = [contestant for contestant in self.contestants if contestant.controller == baseline]

    def flights(self, conditions: Iterable[Condition]) -> dict[Contestant, Flights]:
        """Contestant -> how many of its trials in these conditions were completed."""
        counts: dict[Contestant, Flights] = {}
        for condition in conditions:
            cells = {who: self.cells[condition, who] for who in self.conditions[condition]}
            possible = {flown.seed for cell in cells.values() for flown in cell if flown.outcome != "infeasible"}
            for who, cell in cells.items():
                ended = sum(f.complete for f in cell)
                trials = sum(f.seed in possible for f in cell)
                counts[who] = counts.get(who, Flights(0, 0)).plus(Flights(ended, trials))
        return counts

    def common(self, conditions: Iterable[Condition]) -> Common:
        """Who is compared over these conditions, and over which flights."""
        ended: dict[Contestant, set[tuple[Condition, int]]] = {}
        for condition in conditions:
            for contestant, by_seed in self.conditions[condition].items():
                good = [seed for seed, same in by_seed.items() if all(flown.complete for flown in same)]
                ended.setdefault(contestant, set()).update((condition, seed) for seed in good)
        compared, shared = common(ended)
        return Common(tuple(compared), {at: frozenset(seeds) for at, seeds in grouped(shared).items()})

    @cached_property
    def lines(self) -> dict[Condition, Common]:
        """As `common`, of each condition by itself: one line of a table."""
        return {condition: self.common([condition]) for condition in self.conditions}

    def values(self, condition: Condition, contestant: Contestant, place: int, seeds: Set[int]) -> np.ndarray:
        """One metric, one value per seed in ascending order; the mean if a seed was flown more than once."""
        by_seed = self.conditions[condition].get(contestant, {})
        flights = ([flown.values[place] for flown in same] for seed, same in by_seed.items() if seed in seeds)
        return np.array([values[0] if len(values) == 1 else np.mean(values) for values in flights], float)

    def baseline(self, contestant: Contestant) -> Contestant | None:
        """The baseline of a contestant; if the baseline flew with several settings, the one with the same settings."""
        alike = self._baselines
        if contestant in alike:
            return None
        if len(alike) > 1:
            alike = [who for who in alike if who.settings == contestant.settings]
        return alike[0] if len(alike) == 1 else None

    def pairs(
        self, condition: Condition, contestant: Contestant, rival: Contestant
    ) -> tuple[list[tuple[Flown, Flown]], Counter[str]]:
        """Flights of the same seed that both completed, whoever else did, and the number of other seeds by cause."""
        flights = self.conditions[condition].get(contestant, {})
        rivals = self.conditions[condition].get(rival, {})
        name = self.labels[rival]
        pairs: list[tuple[Flown, Flown]] = []
        causes: Counter[str] = Counter()
        for seed in sorted({*flights, *rivals}):
            mine = flights.get(seed, [])
            its = rivals.get(seed, [])
            if len(mine) > 1 or len(its) > 1:
                causes["flown more than once"] += 1
            elif not mine:
                causes["not asked for"] += 1
            elif not its:
                causes[f"not asked of {name}"] += 1
            elif mine[0].outcome == its[0].outcome == "ok":
                pairs.append((mine[0], its[0]))
            else:
                causes[_cause(mine[0].outcome, its[0].outcome, name)] += 1
        return pairs, causes


def _cause(outcome: str, other: str, rival: str) -> str:
    """Why two flights are no pair, of which one at least did not complete. other: outcome of the rival's."""
    if outcome == "ok":
        return f"{other} by {rival}"
    if other == "ok":
        return outcome
    if other == outcome:
        return f"{outcome} as was {rival}"
    return f"{outcome} ({rival} {other})"


def causes_text(causes: Mapping[str, int]) -> str:
    """Such as "2 lost, 1 lost by nominal_mpc"."""
    return ", ".join(f"{count} {cause}" for cause, count in causes.items())
