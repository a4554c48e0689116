"""Who is ahead. In every cell (task, world, seed) of a family, the ranked entries are put in order:

    rank of a flight      1 for the least error of those that completed, ties share their mean rank; all that were lost
                          or not flown come after them, and share theirs
    mean rank             mean over tasks and worlds, then over seeds; its interval is Student's t over six seeds or
                          more: of three, whose ranks are few numbers, it held the mean in 90 % of 2,000 tables for 95
    significantly different            by the paired permutation test of the seeds, p < 1 - CONFIDENCE: six seeds can,
    fewer cannot
    place                 those not significantly different, by the number of flights lost, from the entry that lost the
    fewest come
                          first, then those not significantly different from the fewest of the rest; among them by mean
                          rank
    level                 with the one above: not significantly different by lost flights, nor by their mean ranks
    of the least          geometric mean of error / least error of the cell, over its own completed flights
    against the baseline  ratio of errors over the cells that both completed, seeds paired (pairing.seed_means)

Both are over other cells where flights were lost, so each has its number of cells. Bounds (given the plant's equations)
are shown and take no rank, nor do they make a cell's least error. Ranks and `of the least` depend on who takes part,
the ratio to the baseline does not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import rankdata

from quadexp.names import named
from quadexp.report.inference import NO_INTERVAL, Ratio, least_seeds, log_ratio, mean_interval, paired_permutation
from quadexp.report.pairing import Row, Rows, grouped, seed_means, whole
from quadexp.report.statistics import CONFIDENCE


@dataclass(frozen=True)
class Standing:
    """One entry of a family. place: 0 for a bound. level: not significantly different from the one above. rank,
    rank_low, rank_high: mean rank, NaN for a bound. least: geometric mean of the ratio to the least error of each cell.
    ratio: to the baseline. least_cells, ratio_cells: of how many flights these are. step: median time of the control
    step (s)."""

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


def standings(rows: Rows, *, metric: str = "mean_error", baseline: str = "") -> list[Standing]:
    """The board of one family: ranked entries by place, then bounds by their lost flights and ratio.

    rows: with entry, settings, bound, task, world, seed beside those of a result; every entry has all cells.
    """
    entries = {str(row["entry"]): row for row in rows}
    names = list(entries)
    places = {name: i for i, name in enumerate(entries)}
    cells = {cell: k for k, cell in enumerate(dict.fromkeys(map(cell_of, rows)))}
    errors, steps = np.full((2, len(names), len(cells)), np.inf)  # m, inf for a lost flight; s
    for row in rows:
        at = places[row["entry"]], cells[cell_of(row)]
        errors[at] = _error(row, metric)
        steps[at] = float(row["solve_time_median"])
    of_seed = grouped((cell[2], cells[cell]) for cell in sorted(cells))
    ranked = [i for i, name in enumerate(names) if not entries[name]["bound"]]
    lost = ~np.isfinite(errors)
    ranks = named(ranked, rankdata(errors[ranked], axis=0))  # ties share their mean rank
    seed_losses = np.column_stack([lost[:, k].sum(axis=1) for k in of_seed.values()])
    seed_ranks = {i: np.array([np.mean(of_entry[k]) for k in of_seed.values()]) for i, of_entry in ranks.items()}
    order = _order(seed_losses, seed_ranks)
    least = np.min(errors[ranked], axis=0, initial=np.inf)
    board = []
    for i, name in enumerate(names):
        place = 0
        level = False
        rank = math.nan
        limits = NO_INTERVAL
        if i in seed_ranks:
            place = 1 + order.index(i)
            above = order[max(place - 2, 0)]
            apart = any(_apart(of[i] - of[above]) for of in (seed_losses, seed_ranks))
            level = place > 1 and not apart
            rank = float(np.mean(seed_ranks[i]))
            if len(of_seed) >= least_seeds(1):
                limits = mean_interval(seed_ranks[i], least=1.0)
        ratios = _log_ratios(errors[i], least)
        known = ratios[np.isfinite(ratios)]
        other = errors[places[baseline]] if baseline in places and name != baseline else np.full(len(cells), np.inf)
        of_cells = zip(cells, _log_ratios(errors[i], other), strict=True)
        against = {}
        for (task, world, seed), x in of_cells:
            if not math.isnan(x):
                against[(task, world), seed] = float(x)
        times = steps[i][np.isfinite(steps[i])]
        board.append(
            Standing(
                entry=name,
                settings=str(entries[name]["settings"]),
                place=place,
                level=level,
                flights=len(cells),
                lost=int(lost[i].sum()),
                rank=rank,
                rank_low=limits.low,
                rank_high=min(limits.high, len(order)),
                least=math.exp(float(np.mean(known))) if len(known) else math.nan,
                least_cells=len(known),
                ratio=log_ratio(seed_means(against)),
                ratio_cells=len(whole(against.keys())) if against else 0,
                step=float(np.median(times)) if len(times) else math.nan,
            )
        )
    return sorted(board, key=lambda standing: (standing.bound, standing.place, standing.lost, standing.least))


def _order(losses: np.ndarray, ranks: Mapping[int, np.ndarray]) -> list[int]:
    """Entries by place; see the module. losses: of each entry and seed. ranks: entry -> mean rank of each seed."""
    rest = sorted(ranks, key=lambda i: (int(losses[i].sum()), float(np.mean(ranks[i]))))
    order: list[int] = []
    while rest:
        alike = []
        for i in rest:
            if not _apart(losses[i] - losses[rest[0]]):
                alike.append(i)
        order += sorted(alike, key=lambda i: float(np.mean(ranks[i])))
        rest = [i for i in rest if i not in alike]
    return order


def _apart(differences: np.ndarray) -> bool:
    return paired_permutation(differences) < 1 - CONFIDENCE


def cell_of(row: Row) -> tuple[str, str, int]:
    """Task, world, seed."""
    return row["task"], row["world"], int(row["seed"])


def _error(row: Row, metric: str) -> float:
    """The error of a flight, infinite for one that was not completed."""
    value = float(row[metric]) if row["outcome"] == "ok" else math.inf
    if math.isfinite(value):
        return value
    return math.inf


def _log_ratios(errors: np.ndarray, other: np.ndarray) -> np.ndarray:
    """ln(own / other) of each cell, NaN where one was lost or is zero."""
    both = np.isfinite(errors) & np.isfinite(other) & (errors > 0) & (other > 0)
    return np.array([math.log(a / b) if good else math.nan for a, b, good in zip(errors, other, both, strict=True)])
