"""Who is ahead. In every cell (task, world, seed) of a family, the ranked entries are put in order:

    rank of a flight      1 for the least error of those that ended well, ties share their mean rank; all that were lost
                          or not flown come after them, and share theirs
    mean rank             mean over tasks and worlds, then over seeds; its interval is Student's t over six seeds or
                          more: of three, whose ranks are few numbers, it held the mean in 90 % of 2,000 tables for 95
    told apart            by the paired permutation test of the seeds, p < 1 - confidence: six seeds can, fewer cannot
    place                 those not told apart, by the number of flights lost, from the entry that lost the fewest come
                          first, then those not told apart from the fewest of the rest; among them by mean rank
    level                 with the one above: not told apart by lost flights, nor by their mean ranks
    of the least          geometric mean of error / least error of the cell, over its own flights that ended well
    against the baseline  ratio of errors over the cells that both ended well, seeds paired (pairing.seed_means)

Both are over other cells where flights were lost, so each has its number of cells. Bounds (told the plant's equations)
are shown and take no rank, nor do they make a cell's least error. Ranks and `of the least` depend on who takes part,
the ratio to the baseline does not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.report.inference import NO_INTERVAL, Ratio, least_seeds, log_ratio, mean_interval, paired_permutation
from quadexp.report.pairing import seed_means, whole

Row = Mapping[str, Any]
Cell = tuple[str, str, int]  # task, world, seed


@dataclass(frozen=True)
class Standing:
    """One entry of a family. place: 0 for a bound. level: not told apart from the one above. rank, rank_low, rank_high:
    mean rank, NaN for a bound. least: geometric mean of the ratio to the least error of each cell. ratio: to the
    baseline. least_cells, ratio_cells: of how many flights these are. step: median time of the control step (s)."""

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
    least_cells: int
    ratio: Ratio
    ratio_cells: int
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
    losses = {name: _losses(by_cell, name, metric) for name in entries}
    lost = {name: int(losses[name].sum()) for name in entries}
    made = []
    order = _order(losses, ranks, confidence)
    for place, name in enumerate(order, 1):
        above = order[place - 2] if place > 1 else name
        apart = any(_apart(of[name] - of[above], confidence) for of in (losses, ranks))
        few = len(ranks[name]) < least_seeds(1, confidence)
        limits = NO_INTERVAL if few else mean_interval(ranks[name], confidence, least=1.0)
        mean = float(np.mean(ranks[name]))
        made.append((name, place, place > 1 and not apart, mean, limits.low, min(limits.high, len(order))))
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
            *_of_least(by_cell, name, ranked, metric),
            *_against(by_cell, name, baseline, metric, confidence),
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


def _losses(by_cell: Mapping[Cell, Mapping[str, Row]], name: str, metric: str) -> np.ndarray:
    """Number of flights of each seed that did not end well, (seeds,)."""
    found: dict[int, int] = {}
    for (_, _, seed), cell in sorted(by_cell.items()):
        found[seed] = found.get(seed, 0) + (not math.isfinite(_error(cell[name], metric)))
    return np.array(list(found.values()))


def _order(losses: Mapping[str, np.ndarray], ranks: Mapping[str, np.ndarray], confidence: float) -> list[str]:
    """Names by place; see the module."""
    rest = sorted(ranks, key=lambda name: (int(losses[name].sum()), float(np.mean(ranks[name]))))
    order: list[str] = []
    while rest:
        alike = [name for name in rest if not _apart(losses[name] - losses[rest[0]], confidence)]
        order += sorted(alike, key=lambda name: float(np.mean(ranks[name])))
        rest = [name for name in rest if name not in alike]
    return order


def _apart(differences: np.ndarray, confidence: float) -> bool:
    return paired_permutation(differences) < 1 - confidence


def _error(row: Row, metric: str) -> float:
    """The error of a flight, infinite for one that did not end well."""
    value = float(row[metric]) if row["outcome"] == "ok" else math.inf
    return value if math.isfinite(value) else math.inf


def _of_least(
    by_cell: Mapping[Cell, Mapping[str, Row]], name: str, ranked: Sequence[str], metric: str
) -> tuple[float, int]:
    logs = []
    for cell in by_cell.values():
        least, own = min((_error(cell[one], metric) for one in ranked), default=math.inf), _error(cell[name], metric)
        if math.isfinite(own) and math.isfinite(least) and own > 0 and least > 0:
            logs.append(math.log(own / least))
    return math.exp(float(np.mean(logs))) if logs else math.nan, len(logs)


def _against(
    by_cell: Mapping[Cell, Mapping[str, Row]], name: str, baseline: str, metric: str, confidence: float
) -> tuple[Ratio, int]:
    logs: dict[tuple[tuple[str, str], int], float] = {}
    for (task, world, seed), cell in by_cell.items():
        if name == baseline or baseline not in cell:
            continue
        own, other = _error(cell[name], metric), _error(cell[baseline], metric)
        if math.isfinite(own) and math.isfinite(other) and own > 0 and other > 0:
            logs[(task, world), seed] = math.log(own / other)
    return log_ratio(seed_means(logs), confidence), len(whole(logs.keys())) if logs else 0


def _step(by_cell: Mapping[Cell, Mapping[str, Row]], name: str) -> float:
    times = [float(cell[name]["solve_time_median"]) for cell in by_cell.values()]
    known = [time for time in times if math.isfinite(time)]
    return float(np.median(known)) if known else math.nan
