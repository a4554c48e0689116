"""Which flights are compared with which: conditions, contestants, and pairs over the seeds.

A condition is what was flown: plant, vehicle, trajectory, speed and any other setting that varies within the sweep; a
contestant is who flew it: controller, checkpoint and the controller's own settings. Flights of one condition and seed
met the same noise, whoever flew: they make a pair.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from quadexp.report.common import Flights, common

Row = Mapping[str, Any]
Condition = tuple[str, str, str, float | None, str]  # plant, vehicle, trajectory, speed (m/s), other settings
Contestant = tuple[str, str, str]  # controller, model, its own settings
World = tuple[str, str]  # plant, vehicle
BOUNDS = ("perfect_", "oracle_")  # controllers that know what nobody can know: they take part in no ranking

_BEFORE_KEY = re.compile(r" (?=[\w./@]+=)")  # values may hold blanks
_KEYS_ABOVE = re.compile(r"^[^=]*\.(?=[^=.]*=)")


def split_variant(variant: str) -> tuple[str, str]:
    """What varies within a sweep, as (of the controller, of the condition): "controller.nodes=20 plant.payload=0.1"."""
    parts = _BEFORE_KEY.split(variant) if variant else []
    own = [part for part in parts if part.startswith("controller.")]
    return " ".join(own), " ".join(part for part in parts if part not in own)


def condition_of(row: Row) -> Condition:
    speed = row["speed"]
    speed = None if speed is None or math.isnan(float(speed)) else float(speed)
    return row["plant"], row["vehicle"], row["trajectory"], speed, split_variant(row.get("variant") or "")[1]


def contestant_of(row: Row) -> Contestant:
    return row["controller"], row["model"], split_variant(row.get("variant") or "")[0]


def is_bound(controller: str) -> bool:
    return controller.startswith(BOUNDS)


def contestant_labels(contestants: Sequence[Contestant]) -> dict[Contestant, str]:
    """The controller's name, and of checkpoint and settings what tells it from the others."""
    models: dict[str, set[str]] = {}
    for controller, model, _ in contestants:
        models.setdefault(controller, set()).add(model)
    paths = set().union(*models.values()) if models else set()
    short = {path: path.rstrip("/").rpartition("/")[2] for path in paths}
    if len(set(short.values())) < len(paths):  # two checkpoints of one name: say where they lie
        short = {path: path for path in paths}
    labels = {}
    for controller, model, variant in contestants:
        parts = [controller, short[model] if len(models[controller]) > 1 and model else "", *variant_parts(variant)]
        labels[controller, model, variant] = " ".join(part for part in parts if part)
    count = Counter(labels.values())
    for one in (one for one, label in labels.items() if count[label] > 1):  # shortened beyond recognition: say all
        labels[one] = " ".join(part for part in one if part)
    return labels


def variant_parts(variant: str) -> list[str]:
    """The settings of a variant, each without the groups above it: "controller.nodes=20" is said as "nodes=20"."""
    return [_KEYS_ABOVE.sub("", part) for part in _BEFORE_KEY.split(variant) if part]


class Flown(NamedTuple):
    """What statistics need of a row. values: of the metrics, in the order they were asked for."""

    seed: int
    outcome: str
    values: tuple[float, ...]


class Common(NamedTuple):
    """Who is compared, and condition -> seeds of the flights that all of them ended well."""

    compared: tuple[Contestant, ...]
    seeds: Mapping[Condition, frozenset[int]]

    @property
    def flights(self) -> int:
        return sum(map(len, self.seeds.values()))


class Groups:
    """The flights of a comparison, by condition and contestant in order of first appearance."""

    def __init__(self, rows: Sequence[Row], baseline: str, metrics: Sequence[str]) -> None:
        self.cells: dict[tuple[Condition, Contestant], list[Flown]] = {}
        for row in rows:
            flown = Flown(int(row["seed"]), str(row["outcome"]), tuple(float(row[metric]) for metric in metrics))
            self.cells.setdefault((condition_of(row), contestant_of(row)), []).append(flown)
        self.contestants = list(dict.fromkeys(contestant for _, contestant in self.cells))
        self.labels = contestant_labels(self.contestants)
        self._rivals = [c for c in self.contestants if c[0] == baseline]
        self._common: dict[Condition, Common] = {}
        self._by_cell: dict[tuple[Condition, Contestant], tuple[dict[int, int], np.ndarray]] = {}

    @cached_property
    def worlds(self) -> dict[World, list[Condition]]:
        """Plant and vehicle -> the conditions that were asked for there."""
        found: dict[World, dict[Condition, None]] = {}
        for condition, _ in self.cells:
            found.setdefault(condition[:2], {})[condition] = None
        return {world: list(conditions) for world, conditions in found.items()}

    @cached_property
    def _by_condition(self) -> dict[Condition, dict[Contestant, list[Flown]]]:
        found: dict[Condition, dict[Contestant, list[Flown]]] = {}
        for (condition, contestant), group in self.cells.items():
            found.setdefault(condition, {})[contestant] = group
        return found

    def flights(self, conditions: Iterable[Condition]) -> dict[Contestant, Flights]:
        """Everybody that was asked to fly there -> how many of its trials ended well; see common.py."""
        counts: dict[Contestant, list[int]] = {}
        for condition in conditions:
            here = self._by_condition.get(condition, {})
            possible = {f.seed for group in here.values() for f in group if f.outcome != "infeasible"}
            for contestant, group in here.items():
                count = counts.setdefault(contestant, [0, 0])
                count[0] += sum(f.outcome == "ok" for f in group)
                count[1] += sum(f.seed in possible for f in group)
        return {contestant: Flights(*count) for contestant, count in counts.items()}

    def common(self, conditions: Iterable[Condition]) -> Common:
        """Who is compared over these conditions, and over which flights; see common.py."""
        ended: dict[Contestant, set[tuple[Condition, int]]] = {}
        for condition in conditions:
            for contestant, group in self._by_condition.get(condition, {}).items():
                bad = {f.seed for f in group if f.outcome != "ok"}
                good = {(condition, f.seed) for f in group if f.seed not in bad}
                ended.setdefault(contestant, set()).update(good)
        compared, shared = common(ended)
        seeds: dict[Condition, set[int]] = {}
        for condition, seed in shared:
            seeds.setdefault(condition, set()).add(seed)
        return Common(tuple(compared), {at: frozenset(s) for at, s in seeds.items()})

    def common_in(self, condition: Condition) -> Common:
        """As `common`, of one condition: what stands in one line of a table."""
        if condition not in self._common:
            self._common[condition] = self.common([condition])
        return self._common[condition]

    def values(self, condition: Condition, contestant: Contestant, place: int, seeds: Set[int]) -> np.ndarray:
        """Of one metric, one value a seed in ascending order; the mean where a seed was flown more than once."""
        own, values = self._values(condition, contestant)
        if seeds >= own.keys():
            return values[:, place]
        return values[[i for seed, i in own.items() if seed in seeds], place]

    def _values(self, condition: Condition, contestant: Contestant) -> tuple[dict[int, int], np.ndarray]:
        """Seed -> row, ascending, and the values of all metrics, a row a seed."""
        at = condition, contestant
        if at not in self._by_cell:
            group = sorted(self.cells.get(at, []), key=lambda f: f.seed)
            seeds = dict.fromkeys(f.seed for f in group)
            values = np.array([f.values for f in group], float).reshape(len(group), -1)
            if len(seeds) < len(group):
                places = {seed: [i for i, f in enumerate(group) if f.seed == seed] for seed in seeds}
                values = np.array([values[rows].mean(axis=0) for rows in places.values()])
            self._by_cell[at] = {seed: i for i, seed in enumerate(seeds)}, values
        return self._by_cell[at]

    def baseline(self, contestant: Contestant) -> Contestant | None:
        """Whom to compare with: the baseline controller; where it flew with several settings, with the same ones."""
        if contestant in self._rivals or not self._rivals:
            return None
        if len(self._rivals) == 1:
            return self._rivals[0]
        same = [rival for rival in self._rivals if rival[2] == contestant[2]]
        return same[0] if len(same) == 1 else None

    def pairs(
        self, condition: Condition, contestant: Contestant, rival: Contestant, among: Common | None = None
    ) -> tuple[list[tuple[Flown, Flown]], Counter[str]]:
        """Flights of one seed each that both ended well, and what was left out, by cause.

        among: take only the flights that all who are compared ended well, where these two are among them.
        """
        shared = among.seeds.get(condition, frozenset()) if among and {contestant, rival} <= {*among.compared} else None
        own, others = (_by_seed(self.cells.get((condition, who), [])) for who in (contestant, rival))
        name = self.labels[rival]
        pairs: list[tuple[Flown, Flown]] = []
        causes: Counter[str] = Counter()
        for seed in sorted({*own, *others}):
            mine, its = own.get(seed, []), others.get(seed, [])
            if len(mine) > 1 or len(its) > 1:
                causes["flown more than once"] += 1
            elif not mine or not its:
                causes["not asked for" if not mine else f"not asked of {name}"] += 1
            elif mine[0].outcome != "ok":
                mine_was, its_was = mine[0].outcome, its[0].outcome
                also = f" as was {name}" if its_was == mine_was else f" ({name} {its_was})" if its_was != "ok" else ""
                causes[mine_was + also] += 1
            elif its[0].outcome != "ok":
                causes[f"{its[0].outcome} by {name}"] += 1
            elif shared is not None and seed not in shared:
                causes["not ended well by all"] += 1
            else:
                pairs.append((mine[0], its[0]))
        return pairs, causes


def _by_seed(flights: Iterable[Flown]) -> dict[int, list[Flown]]:
    found: dict[int, list[Flown]] = {}
    for flown in flights:
        found.setdefault(flown.seed, []).append(flown)
    return found


def said(causes: Mapping[str, int]) -> str:
    """Such as "2 lost, 1 lost by nominal_mpc"."""
    return ", ".join(f"{count} {cause}" for cause, count in causes.items())
