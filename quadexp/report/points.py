"""What a figure shows at each of its places: a mean with its interval, and how many flights were completed.

A place is one value of every key that the figure shows (x, lines, panels). Its mean is over the common flights, by the
one rule of every table (pairing.py): places that differ in keys of the controller stand beside each other, and are over
the flights that all of them completed. Settings that the figure does not show are averaged, seed by seed:

    mean      over the seeds, of the mean over the other settings of that seed
    interval  of the mean over the seeds, as in tables (inference.mean_interval); of a share, where each flight has a
              seed of its own
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quadexp.report.frame import SweepFrame, of_controller
from quadexp.report.inference import mean_interval, success_interval
from quadexp.report.pairing import common, is_flown, is_invalid, seed_means

Place = tuple[Any, ...]  # a value of each key that is shown
SUCCESS = "success"  # the share of completed flights


@dataclass(frozen=True)
class Point:
    """mean, low, high: NaN where there is no common flight. flights, seeds: in the mean. ended: flights that ended
    well, of trials. lost: outcome -> number of the others. method: of the interval. invalid: why there was nothing to
    fly."""

    mean: float
    low: float
    high: float
    flights: int
    seeds: int
    ended: int
    trials: int
    lost: Mapping[str, int] = field(default_factory=dict)
    method: str = "none"
    invalid: str = ""

    @property
    def is_shown(self) -> bool:
        return math.isfinite(self.mean)


def points(
    frame: SweepFrame, keys: Sequence[str], y: str, *, others: Sequence[str] = (), confidence: float = 0.95
) -> dict[Place, Point]:
    """Place -> point, in the order of the rows. keys: what a place has a value of. y: a number of the flights, or
    "success". others: keys that vary beside them, which are averaged. A flight without a value of a key has no place.
    """
    columns = [shown_column(frame, key, keys) for key in keys]
    others_columns = [frame.column(key) for key in others]
    values = [1.0] * len(frame.rows) if y == SUCCESS else frame.column(y)
    flights = [(tuple(column[i] for column in others_columns), row["seed"]) for i, row in enumerate(frame.rows)]
    well = [is_flown(row) and value is not None for row, value in zip(frame.rows, values, strict=True)]
    places: dict[Place, list[int]] = {}  # place -> rows
    groups: dict[Place, list[Place]] = {}  # what is flown -> places
    for i, place in enumerate(zip(*columns, strict=True)):
        if None not in place:
            places.setdefault(place, []).append(i)
    for place in places:
        flown = tuple(value for value, key in zip(place, keys, strict=True) if not of_controller(key))
        groups.setdefault(flown, []).append(place)
    used: dict[Place, list[int]] = {}
    for group in groups.values():
        ended = {
            place: {flights[i] for i in places[place] if well[i]} - {flights[i] for i in places[place] if not well[i]}
            for place in group
        }
        compared, shared = common(ended)
        used |= {place: [i for i in places[place] if flights[i] in shared] for place in compared}
    made = {}
    for place, own in places.items():
        rows = [frame.rows[i] for i in own]
        outcomes = Counter(row["outcome"] for row in rows if not is_invalid(row))
        trials, completed = outcomes.total(), outcomes.pop("ok", 0)
        about: dict[str, Any] = {"ended": completed, "trials": trials, "lost": dict(outcomes)}
        about["invalid"] = "" if trials else str(rows[0]["cause"])
        if y == SUCCESS:
            single = len({row["seed"] for row in rows}) == len(rows)
            low, high = success_interval(completed, trials, confidence) if single else (math.nan, math.nan)
            share = completed / trials if trials else math.nan
            made[place] = Point(share, low, high, trials, 0, method="Clopper-Pearson", **about)
            continue
        errors: dict[tuple[Place, int], list[float]] = {}
        for i in used.get(place, ()):
            errors.setdefault(flights[i], []).append(float(values[i]))
        means = seed_means({flight: np.mean(several) for flight, several in errors.items()})
        if not len(means):
            made[place] = Point(math.nan, math.nan, math.nan, 0, 0, **about)
            continue
        low, high, method = mean_interval(means, confidence, least=0.0 if min(means) >= 0 else -math.inf)
        made[place] = Point(float(means.mean()), low, high, len(used[place]), len(means), method=method, **about)
    return made


def shown_column(frame: SweepFrame, key: str, keys: Sequence[str]) -> list[Any]:
    """The column of a key as a figure of these keys shows it: a flight without a checkpoint has an empty one, and the
    name of a controller has no remedy in it that is a key of its own."""
    if key == "controller":
        return frame.controllers(keys)
    return [row["model"] or "" for row in frame.rows] if key == "model" else frame.column(key)
