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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quadexp.report.frame import SweepFrame, of_controller
from quadexp.report.inference import mean_interval, success_interval
from quadexp.report.pairing import common, seed_means

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
    columns = {key: shown_column(frame, key, keys) for key in keys}
    mine = [of_controller(key) for key in keys]
    rest = list(zip(*(frame.column(key) for key in others), strict=True)) if others else [()] * len(frame.rows)
    values = None if y == SUCCESS else frame.column(y)
    groups: dict[Place, dict[Place, list[int]]] = {}  # what is flown -> place -> rows
    order: dict[Place, None] = {}
    for i, place in enumerate(zip(*columns.values(), strict=True)):
        if None in place:
            continue
        order.setdefault(place)
        at = tuple(value for value, own in zip(place, mine, strict=True) if not own)
        groups.setdefault(at, {}).setdefault(place, []).append(i)
    made: dict[Place, Point] = {}
    for group in groups.values():
        ended = {
            place: {(rest[i], frame.rows[i]["seed"]) for i in own if _has(frame, values, i)}
            - {(rest[i], frame.rows[i]["seed"]) for i in own if not _has(frame, values, i)}
            for place, own in group.items()
        }
        compared, shared = common(ended)
        for place, own in group.items():
            used = [i for i in own if (rest[i], frame.rows[i]["seed"]) in shared] if place in compared else []
            made[place] = _point(frame, own, used, values, rest, confidence)
    return {place: made[place] for place in order}


def shown_column(frame: SweepFrame, key: str, keys: Sequence[str]) -> list[Any]:
    """The column of a key as a figure of these keys shows it: a flight without a checkpoint has an empty one, and the
    name of a controller has no remedy in it that is a key of its own."""
    if key == "controller":
        return frame.controllers(keys)
    return [row["model"] or "" for row in frame.rows] if key == "model" else frame.column(key)


def _has(frame: SweepFrame, values: Sequence[Any] | None, i: int) -> bool:
    return frame.rows[i]["outcome"] == "ok" and (values is None or values[i] is not None)


def _point(
    frame: SweepFrame, own: Sequence[int], used: Sequence[int], values: Sequence[Any] | None,
    rest: Sequence[Any], confidence: float,
) -> Point:  # fmt: skip
    rows = [frame.rows[i] for i in own]
    wrong = [str(row["cause"]) for row in rows if row["outcome"] == "invalid"]
    lost: dict[str, int] = {}
    for row in rows:
        if row["outcome"] not in ("ok", "invalid"):
            lost[row["outcome"]] = lost.get(row["outcome"], 0) + 1
    ended = sum(row["outcome"] == "ok" for row in rows)
    trials = len(rows) - len(wrong)
    about: dict[str, Any] = {"ended": ended, "trials": trials, "lost": lost, "invalid": "" if trials else wrong[0]}
    if values is None:
        single = len({row["seed"] for row in rows}) == len(rows)
        low, high = success_interval(ended, trials, confidence) if single else (math.nan, math.nan)
        share = ended / trials if trials else math.nan
        return Point(share, low, high, trials, 0, method="Clopper-Pearson", **about)
    flown: dict[tuple[Any, int], list[float]] = {}
    for i in used:
        flown.setdefault((rest[i], frame.rows[i]["seed"]), []).append(float(values[i]))
    means = seed_means({at: np.mean(several) for at, several in flown.items()})
    if not len(means):
        return Point(math.nan, math.nan, math.nan, 0, 0, **about)
    limits = mean_interval(means, confidence, least=0.0 if min(means) >= 0 else -math.inf)
    return Point(float(means.mean()), limits.low, limits.high, len(used), len(means), method=limits.method, **about)
