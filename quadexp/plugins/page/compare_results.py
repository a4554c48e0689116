"""What differs between results: flights paired by condition, contestant and seed.

Of two results a and b, the errors of a contestant are those of the flights that it completed in both, whatever others
completed. b is compared with a as a contestant is with a baseline in statistics.py: by a mean ratio over the seeds with
its interval and the test of inference.py, over all conditions, corrected by Holm over the contestants. b is "not
distinguishable" if that is not significant, and "n seeds cannot tell" where it could not be. Of several results, means
are over the flights that all contestants completed in all of them (pairing.py).
"""

from __future__ import annotations

import contextlib
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from quadexp.errors import QuadexpError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_metadata
from quadexp.names import distinct
from quadexp.plugins.page.differences import Settings, change, differing, names_of, record_of, setting_lines
from quadexp.plugins.page.typeset import relative
from quadexp.report.frame import read_results
from quadexp.report.inference import holm
from quadexp.report.metrics import METRICS, metric_of
from quadexp.report.pairing import (
    Condition,
    Contestant,
    Row,
    Rows,
    causes_text,
    common,
    condition_of,
    contestant_labels,
    contestant_of,
    grouped,
    is_flown,
    is_invalid,
)
from quadexp.report.statistics import Statistic, overall
from quadexp.report.table import Table
from quadexp.report.text import count, number, p_value

MOST_CONFIGURATIONS = 40  # cells whose configurations are read on either side
EXACT = ["outcome", *(name for name in METRICS if not name.startswith("solve_time"))]  # the same for the same flight
NOTE = "means over the flights that all of them completed in every one of these results"

Key = tuple[Condition, Contestant, int]  # with the seed
Cells = dict[Key, tuple[Row, ...]]  # a row of each results
Report = dict[str, Any]


def compare_results(paths: Sequence[Path]) -> Report:
    """Results folders; see the module. The metric is the first one's."""
    _, tables, records = zip(*map(read_results, paths), strict=True)
    metric = records[0].get("metric", "mean_error")
    sides = matched(*tables)
    cells = {}
    for key in sides[0]:
        if all(key in side for side in sides):
            cells[key] = tuple(side[key] for side in sides)
    labels = contestant_labels(distinct(who for _, who, _ in cells))
    means = _common_means(cells, labels, metric)
    about = metric_of(metric)
    report: Report = {"metric": metric, "metrics": {}}
    rows = []
    for label, (of_sides, flights) in means.items():
        numbers = [number(about.factor * mean) for mean in of_sides]
        rows.append([label, *numbers, str(flights)])
        report["metrics"][label] = of_sides
    heads = [f"{about.title} ({about.unit})", *names_of(paths), "flights"]
    report["tables"] = [Table(heads, rows, notes=[NOTE])]
    if len(paths) > 2:
        return report
    only = {"a": _missing(*sides), "b": _missing(*sides[::-1])}
    report |= {"pairs": len(cells), "only": only, "configuration": {}, "outcome": {}, "metrics": []}
    lines = [f"{name}  {path}: {len(side)} cells" for name, path, side in zip("ab", paths, sides, strict=True)]
    lines.append("")
    for name, missing in only.items():
        if missing:
            lines.append(f"only in {name}  {causes_text(missing)}")
    if not cells:
        return report | {"lines": [*lines, "no cell is in both: nothing to compare"]}
    settings = _cell_settings(paths, cells)
    outcomes = Counter((was["outcome"], now["outcome"]) for was, now in cells.values())
    changed = [f"{n} {was}" if was == now else f"{n} {was} -> {now}" for (was, now), n in outcomes.items()]
    before, after = (pd.DataFrame(rows, columns=EXACT) for rows in zip(*cells.values(), strict=True))
    alike = (before == after) | (before.isna() & after.isna())
    same = int(alike.all(axis=1).sum())
    contestants = _contestants(cells, labels, metric, records[0].get("confidence", 0.95))
    lines += [*setting_lines(settings), "", f"outcome  {', '.join(changed)}"]
    lines += [f"same     {same} of {len(cells)} pairs are the same to the last bit, measured times apart", ""]
    report["configuration"] = settings or {}
    report["outcome"] = {f"{was} -> {now}": n for (was, now), n in outcomes.items()}
    report["identical"] = same
    report["metrics"] = contestants
    return report | {"lines": [*lines, *_contestant_table(contestants, metric).lines()]}


def matched(*tables: Rows) -> list[dict[Key, Row]]:
    """Rows by condition, contestant and seed; with the checkpoint only where it distinguishes contestants."""
    several = set()  # controllers with their settings that flew with several checkpoints
    for rows in tables:
        checkpoints = Counter((who.controller, who.settings) for who in set(map(contestant_of, rows)))
        several |= {who for who, n in checkpoints.items() if n > 1}
    sides = []
    for rows in tables:
        side: dict[Key, Row] = {}
        for row in rows:
            who = contestant_of(row)
            if (who.controller, who.settings) not in several:
                who = who._replace(model="")
            key = condition_of(row), who, row["seed"]
            if key not in side or not is_invalid(row):
                side[key] = row
        sides.append(side)
    return sides


def _common_means(cells: Cells, labels: Mapping[Contestant, str], metric: str) -> dict[str, tuple[list[float], int]]:
    """Label -> mean in each results over the common flights, and their number."""
    completed: dict[Contestant, set[tuple[Condition, int]]] = {who: set() for who in labels}
    for (at, who, seed), rows in cells.items():
        if all(map(is_flown, rows)):
            completed[who].add((at, seed))
    compared, shared = common(completed)
    n_sides = len(next(iter(cells.values()), ()))
    means = {}
    for who, label in labels.items():
        flights = []
        if who in compared:
            flights = [cells[at, who, seed] for at, seed in sorted(shared, key=str)]
        of_sides = []
        for i in range(n_sides):
            of_sides.append(_mean([rows[i] for rows in flights], metric))
        means[label] = of_sides, len(flights)
    return means


def _mean(rows: Rows, metric: str) -> float:
    if rows:
        return sum(row[metric] for row in rows) / len(rows)
    return math.nan


def _missing(mine: Mapping[Key, Row], its: Mapping[Key, Row]) -> dict[str, int]:
    """Label -> number of own cells that are not in the other table."""
    labels = contestant_labels(distinct(who for _, who, _ in mine))
    return dict(Counter(labels[key[1]] for key in mine if key not in its))


def _cell_settings(roots: Sequence[Path], cells: Cells) -> Settings | None:
    """Settings that differ between the cells of a pair, one pair per condition and contestant; None without cells."""
    pairs = grouped((key[:2], rows) for key, rows in cells.items())
    compared: list[tuple[str, Any]] = []
    read = False
    for rows, *_ in list(pairs.values())[:MOST_CONFIGURATIONS]:
        with contextlib.suppress(QuadexpError):  # a failed cell has no file
            records = []
            for root, row in zip(roots, rows, strict=True):
                file = CellStore(root).path(row["key"])
                records.append(record_of(read_metadata(file, "flight")))
            compared += differing(*records).items()
            read = True
    if not read:
        return None
    settings = {}
    for key, several in grouped(compared).items():
        settings[key] = [_any_of(side) for side in zip(*several, strict=True)]
    return settings


def _any_of(values: Sequence[Any]) -> Any:
    """The value of all pairs, or the texts of different ones."""
    texts = sorted(set(map(str, values)))
    return values[0] if len(texts) == 1 else " | ".join(texts)


def _contestants(cells: Cells, labels: Mapping[Contestant, str], metric: str, confidence: float) -> list[Report]:
    """For each contestant: completed flights, means of a and b over those that it completed in both, b against a."""
    pairs_of = grouped((who, pair) for (_, who, _), pair in cells.items())
    compared: dict[Contestant, Statistic] = {}
    for who, pairs in pairs_of.items():
        rows = []
        for pair in pairs:
            for side, row in zip("ab", pair, strict=True):
                rows.append({**row, "controller": side, "model": "", "variant": condition_of(row).setting})
        for statistic in overall(rows, metric=metric, baseline="a", confidence=confidence):
            compared[who] = statistic  # there is none where the settings contradict each other
    corrected = holm(np.array([s.p for s in compared.values()]))
    tests = int(np.count_nonzero(~np.isnan(corrected)))
    records = []
    for (who, s), p_holm in zip(compared.items(), corrected.tolist(), strict=True):
        s = replace(s, p_holm=p_holm, comparisons=tests)
        pairs = pairs_of[who]
        completed = [pair for pair in pairs if all(is_flown(row) and math.isfinite(row[metric]) for row in pair)]
        flown = {}
        means = []
        for i, side in enumerate("ab"):
            flown[side] = [sum(is_flown(pair[i]) for pair in pairs), len(pairs)]
            means.append(_mean([pair[i] for pair in completed], metric))
        about = {"label": labels[who], "cells": len(pairs), "flown": flown, "left_out": s.left_out}
        test = {
            "pairs": s.pairs,
            "seeds": s.units,
            "p": s.p,
            "p_holm": s.p_holm,
            "testable": s.testable,
            "ratio": -s.reduction,
            "ratio_low": -s.reduction_high,
            "ratio_high": -s.reduction_low,
            "distinguishable": s.significant,
        }
        records.append(about | change(*means) | test)
    return records


def _contestant_table(contestants: Sequence[Mapping[str, Any]], metric: str) -> Table:
    about = metric_of(metric)
    rows = []
    left_out = []
    for record in contestants:
        ratio = relative(record["ratio"])
        if record["ratio"] and not math.isnan(record["ratio_low"]):
            ratio += f" [{record['ratio_low']:+.3g}, {record['ratio_high']:+.3g}]"
        flown = [f"{k} of {n}" for k, n in record["flown"].values()]
        numbers = [number(about.factor * record[name]) for name in ("a", "b", "difference")]
        p = p_value(record["p_holm"] if record["testable"] else math.nan)
        counts = [str(record["pairs"]), str(record["seeds"])]
        rows.append([record["label"], *flown, *counts, *numbers, ratio, p, _verdict(record)])
        if record["left_out"]:
            left_out.append(f"  {record['label']}: left out {re.sub(r' by a(?=,|$)', ' in a', record['left_out'])}")
    heads = [f"{about.title} ({about.unit})", "flown a", "flown b", "pairs", "seeds", "a", "b", "b - a", "ratio"]
    return Table([*heads, "p (Holm)", "b is"], rows, notes=left_out)


def _verdict(record: Mapping[str, Any]) -> str:
    """What b is beside a, in words."""
    ratio = record["ratio"]
    if math.isnan(ratio):
        return "-"
    if ratio == 0:
        return "the same"
    if record["distinguishable"]:
        return "smaller" if ratio < 0 else "larger"
    if record["testable"]:
        return "not distinguishable"
    return f"{count(record['seeds'], 'seed')} cannot tell"
