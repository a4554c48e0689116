"""The number at every place of a figure or table: a place is one value of every key that it shows.

The mean of a place is over the common flights, by the one rule of every table (pairing.py): places that differ in keys
of the controller stand beside each other, and are over the flights that all of them completed. Settings of the world
that are not shown are averaged, seed by seed:

    mean      over the seeds, of the mean over the other settings of that seed
    interval  of the mean over the seeds, as in tables (inference.mean_interval); of a share, where each flight has a
              seed of its own
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from quadexp.parts.schema import of_contestant
from quadexp.report.frame import SweepFrame
from quadexp.report.inference import mean_interval, success_interval
from quadexp.report.pairing import Row, common, grouped, is_flown, is_invalid, seed_means

Place = tuple[Any, ...]  # a value of each key that is shown
What = tuple[Place, int]  # what a flight flew: its values of the keys that are averaged, and its seed
SUCCESS = "success"  # the share of completed flights


@dataclass(frozen=True)
class Point:
    """mean, low, high: NaN where there is no common flight. flights, seeds: in the mean. ended: flights that ended
    well, of trials. lost: outcome -> number of the others. method: of the interval. invalid: why there was nothing to
    fly."""

    mean: float = math.nan
    low: float = math.nan
    high: float = math.nan
    flights: int = 0
    seeds: int = 0
    ended: int = 0
    trials: int = 0
    lost: Mapping[str, int] = field(default_factory=dict)
    method: str = "none"
    invalid: str = ""

    @property
    def is_shown(self) -> bool:
        return math.isfinite(self.mean)


class _Flight(NamedTuple):
    """value: None for a flight that was not completed, or does not have the number."""

    row: Row
    what: What
    value: float | None


def points(
    frame: SweepFrame, keys: Sequence[str], y: str, *, others: Sequence[str] = (), confidence: float = 0.95
) -> dict[Place, Point]:
    """Place -> point, in the order of the rows. keys: what a place has a value of. y: a number of the flights, or
    "success". others: keys that vary beside them, which are averaged. A flight without a value of a key has no place.
    """
    columns = [shown_column(frame, key, keys) for key in keys]
    averaged = [frame.column(key) for key in others]
    values = [1.0] * len(frame.rows) if y == SUCCESS else frame.column(y)
    places: dict[Place, list[_Flight]] = {}
    for i, row in enumerate(frame.rows):
        place = tuple(column[i] for column in columns)
        if None not in place:
            what = tuple(column[i] for column in averaged), row["seed"]
            value = values[i] if is_flown(row) else None
            places.setdefault(place, []).append(_Flight(row, what, value))
    beside: dict[Place, dict[Place, set[What]]] = {}  # the same course -> place -> completed flights
    for place, flights in places.items():
        course = tuple(value for value, key in zip(place, keys, strict=True) if not of_contestant(key))
        completed = set()
        broken = set()
        for flight in flights:
            if flight.value is not None:
                completed.add(flight.what)
            elif not is_invalid(flight.row):
                broken.add(flight.what)
        beside.setdefault(course, {})[place] = completed - broken
    used: dict[Place, Set[What]] = {}
    for ended in beside.values():
        compared, shared = common(ended)
        used |= dict.fromkeys(compared, shared)
    return {place: _point(flights, used.get(place, set()), y, confidence) for place, flights in places.items()}


def _point(flights: Sequence[_Flight], used: Set[What], y: str, confidence: float) -> Point:
    """The point of the flights of a place. used: what was flown of those in the mean."""
    outcomes = Counter(flight.row["outcome"] for flight in flights if not is_invalid(flight.row))
    trials = outcomes.total()
    ended = outcomes.pop("ok", 0)
    point = Point(ended=ended, trials=trials, lost=outcomes, invalid="" if trials else str(flights[0].row["cause"]))
    if y == SUCCESS:
        seeds = {flight.row["seed"] for flight in flights}
        low = high = math.nan
        if len(seeds) == len(flights):
            low, high = success_interval(ended, trials, confidence)
        share = ended / trials if trials else math.nan
        return replace(point, mean=share, low=low, high=high, flights=trials, method="Clopper-Pearson")
    errors = grouped((f.what, f.value) for f in flights if f.value is not None and f.what in used)
    if not errors:
        return point
    means = seed_means({what: np.mean(values) for what, values in errors.items()})
    low, high, method = mean_interval(means, confidence, least=0.0 if min(means) >= 0 else -math.inf)
    n_flights = sum(map(len, errors.values()))
    mean = float(means.mean())
    return replace(point, mean=mean, low=low, high=high, method=method, flights=n_flights, seeds=len(means))


def shown_column(frame: SweepFrame, key: str, keys: Sequence[str]) -> list[Any]:
    """The column of a key as a figure of these keys shows it: a flight without a checkpoint has an empty one, and the
    name of a controller has no compensation in it that is a key of its own."""
    if key == "controller":
        return frame.controllers(keys)
    if key == "model":
        return [row["model"] or "" for row in frame.rows]
    return frame.column(key)
