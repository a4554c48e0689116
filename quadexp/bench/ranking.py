"""Who is ahead. In every cell (task, world, seed) of a family, the ranked entries are put in order:

    rank of a flight      1 for the least error of those that ended well, ties share their mean rank; all that were lost
                          or not flown come after them, and share theirs
    mean rank             mean over tasks and worlds, then over seeds; its interval is Student's t or BCa over the seeds
    place                 by flights lost, the fewest first, then by mean rank
    level                 with the one above: both lost as many, and the interval of the paired difference of their mean
                          ranks over the seeds contains zero
    of the least          geometric mean of error / least error of the cell, over its flights that ended well
    against the baseline  geometric mean of the ratio of errors over the cells that both ended well, seeds paired

Bounds (told the plant's equations) are shown and take no rank, nor do they make a cell's least error. Ranks and `of the
least` depend on who takes part, the ratio to the baseline does not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.report.inference import Ratio, log_ratio, mean_interval

Row = Mapping[str, Any]
Cell = tuple[str, str, int]  # task, world, seed


@dataclass(frozen=True)
class Standing:
    """One entry of a family. place: 0 for a bound. level: not told apart from the one above. rank, rank_low, rank_high:
    mean rank, NaN for a bound. least: geometric mean of the ratio to the least error of each cell. ratio: to the
    baseline. step: median time of the control step (s)."""

    entry: str
    settings: str
    place: int
    level: bool
    flights: int
    lost: int
    rank: float
    rank_low: float
    rank_high: float
    least: float
    ratio: Ratio
    step: float

    @property
    def bound(self) -> bool:
        return self.place == 0


def standings(
    rows: Sequence[Row], *, metric: str = "mean_error", baseline: str = "", confidence: float = 0.95
) -> list[Standing]:
    """The board of one family: ranked entries by place, then bounds by their lost flights and ratio.

    rows: with entry, settings, bound, task, world, seed beside those of a result; every entry has all cells.
    """
    entries = {row["entry"]: row for row in rows}
    by_cell: dict[Cell, dict[str, Row]] = {}
    for row in rows:
        by_cell.setdefault((row["task"], row["world"], int(row["seed"])), {})[row["entry"]] = row
    ranked = [name for name, row in entries.items() if not row["bound"]]
    ranks = _seed_ranks(by_cell, ranked, metric)
    lost = {name: sum(not _well(cell[name], metric) for cell in by_cell.values()) for name in entries}
    made = []
    order = sorted(ranked, key=lambda name: (lost[name], float(np.mean(ranks[name]))))
    for place, name in enumerate(order, 1):
        above = order[place - 2] if place > 1 else None
        level = above is not None and lost[above] == lost[name] and _level(ranks[name] - ranks[above], confidence)
        limits = mean_interval(ranks[name], confidence, least=1.0)
        made.append((name, place, level, float(np.mean(ranks[name])), limits.low, min(limits.high, len(order))))
    made += [(name, 0, False, math.nan, math.nan, math.nan) for name in entries if entries[name]["bound"]]
    found = [
        Standing(
            name,
            str(entries[name]["settings"]),
            place,
            level,
            len(by_cell),
            lost[name],
            rank,
            low,
            high,
            _of_least(by_cell, name, ranked, metric),
            _against(by_cell, name, baseline, metric, confidence),
            _step(by_cell, name),
        )
        for name, place, level, rank, low, high in made
    ]
    return sorted(found, key=lambda one: (one.bound, one.place, one.lost, one.least))


def cell_ranks(cell: Mapping[str, Row], names: Sequence[str], metric: str) -> dict[str, float]:
    """The ranks of one cell; see the module."""
    values = np.array([_error(cell[name], metric) for name in names])  # inf for lost
    below = (values[None, :] < values[:, None]).sum(axis=1)
    same = (values[None, :] == values[:, None]).sum(axis=1)
    return dict(zip(names, below + (same + 1) / 2, strict=True))


def _seed_ranks(by_cell: Mapping[Cell, Mapping[str, Row]], names: Sequence[str], metric: str) -> dict[str, np.ndarray]:
    """Entry -> mean rank of each seed, (seeds,)."""
    found: dict[int, list[dict[str, float]]] = {}
    for (_, _, seed), cell in sorted(by_cell.items()):
        found.setdefault(seed, []).append(cell_ranks(cell, names, metric))
    return {name: np.array([np.mean([one[name] for one in cells]) for cells in found.values()]) for name in names}


def _level(differences: np.ndarray, confidence: float) -> bool:
    limits = mean_interval(differences, confidence)
    return not (limits.low > 0 or limits.high < 0)  # no interval of one seed: not told apart


def _well(row: Row, metric: str) -> bool:
    return math.isfinite(_error(row, metric))


def _error(row: Row, metric: str) -> float:
    """The error of a flight, infinite for one that did not end well."""
    value = float(row[metric]) if row["outcome"] == "ok" else math.inf
    return value if math.isfinite(value) else math.inf


def _of_least(by_cell: Mapping[Cell, Mapping[str, Row]], name: str, ranked: Sequence[str], metric: str) -> float:
    logs = []
    for cell in by_cell.values():
        least, own = min((_error(cell[one], metric) for one in ranked), default=math.inf), _error(cell[name], metric)
        if math.isfinite(own) and math.isfinite(least) and own > 0 and least > 0:
            logs.append(math.log(own / least))
    return math.exp(float(np.mean(logs))) if logs else math.nan


def _against(
    by_cell: Mapping[Cell, Mapping[str, Row]], name: str, baseline: str, metric: str, confidence: float
) -> Ratio:
    logs: dict[tuple[str, str], list[float]] = {}
    for (task, world, _), cell in sorted(by_cell.items()):
        if name == baseline or baseline not in cell:
            continue
        own, other = _error(cell[name], metric), _error(cell[baseline], metric)
        if math.isfinite(own) and math.isfinite(other) and own > 0 and other > 0:
            logs.setdefault((task, world), []).append(math.log(own / other))
    return log_ratio([np.array(values) for values in logs.values()], confidence)


def _step(by_cell: Mapping[Cell, Mapping[str, Row]], name: str) -> float:
    times = [float(cell[name]["solve_time_median"]) for cell in by_cell.values()]
    known = [time for time in times if math.isfinite(time)]
    return float(np.median(known)) if known else math.nan
