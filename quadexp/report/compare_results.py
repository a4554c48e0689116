"""What differs between results: outcomes, errors, and the settings of their cells.

Flights of two results are paired by condition, contestant and seed. Errors are over the flights that all contestants
completed in both (pairing.py): b is compared with a as a contestant is with a baseline in statistics.py, by a mean
ratio over the seeds with its interval and a paired permutation test; b is "not distinguishable" if that is not
significant, and "n seeds cannot tell" where it could not be.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_metadata, read_table
from quadexp.report.compare_parts import ABSENT, change, differing, record_of, setting_lines
from quadexp.report.inference import holm
from quadexp.report.metrics import METRICS, SHOWN
from quadexp.report.pairing import common, condition_of, contestant_labels, contestant_of
from quadexp.report.result_rows import from_columns
from quadexp.report.statistics import overall
from quadexp.report.summary import RESULTS_FILE
from quadexp.report.table import Table
from quadexp.report.tables import TITLES
from quadexp.report.text import count, number, p_value, relative, speed_text

MOST_CONFIGURATIONS = 40  # cells whose configurations are read on either side
MOST_CONDITIONS = 6  # lines of conditions, the largest changes first
EXACT = [name for name in METRICS if not name.startswith("solve_time")]  # the same for the same flight
NOTE = "means over the flights that all of them completed in every one of these results"

Row = Mapping[str, Any]
Key = tuple[Any, ...]  # condition, contestant, seed


def matched(*tables: Sequence[Row]) -> list[dict[Key, Row]]:
    """Rows by condition, contestant and seed; with the checkpoint only where it distinguishes contestants."""
    contestants = ((side, who) for side, rows in enumerate(tables) for who in set(map(contestant_of, rows)))
    models = Counter((side, controller, variant) for side, (controller, _, variant) in contestants)
    several = {who[1:] for who, n in models.items() if n > 1}
    made: list[dict[Key, Row]] = []
    for rows in tables:
        made.append({})
        for row in rows:
            controller, model, variant = contestant_of(row)
            contestant = controller, model if (controller, variant) in several else "", variant
            made[-1][condition_of(row), contestant, row["seed"]] = row
    return made


def compare_results(a: Path, b: Path) -> dict[str, Any]:
    """Two results folders; see the module. The metric is a's."""
    tables = [read_table(path / RESULTS_FILE, "results") for path in (a, b)]
    metric, confidence = tables[0][1].get("metric", "mean_error"), tables[0][1].get("confidence", 0.95)
    left, right = matched(*(from_columns(columns) for columns, _ in tables))
    both = {key: (row, right[key]) for key, row in left.items() if key in right}
    only = {"a": _missing(left, right), "b": _missing(right, left)}
    result: dict[str, Any] = {"metric": metric, "pairs": len(both), "only": only}
    lines = [f"a  {a}: {len(left)} cells", f"b  {b}: {len(right)} cells", ""]
    for side, missing in only.items():
        if missing:
            lines.append(f"only in {side}  " + ", ".join(f"{n} {label}" for label, n in missing.items()))
    if not both:
        lines.append("no cell is in both: nothing to compare")
        return result | {"configuration": {}, "outcome": {}, "metrics": [], "lines": lines}
    settings = _settings(a, b, list(both.values()))
    outcomes = Counter((x["outcome"], y["outcome"]) for x, y in both.values())
    same = sum(x["outcome"] == y["outcome"] and _equal(x, y) for x, y in both.values())
    labels = contestant_labels(list(dict.fromkeys(contestant for _, contestant, _ in both)))
    metrics = _contestants(both, labels, metric, confidence)
    conditions = _conditions(both, labels, metric)
    unknown = ["configuration  not compared: the cells are not beside both tables"]
    lines += [*(unknown if settings is None else setting_lines(settings)), ""]
    lines.append("outcome  " + ", ".join(f"{n} {x if x == y else f'{x} -> {y}'}" for (x, y), n in outcomes.items()))
    lines.append(f"same     {same} of {len(both)} pairs are the same to the last bit, measured times apart")
    lines += ["", *_metric_lines(metrics, metric)]
    if same < len(both):
        lines += ["", "largest changes", *_condition_lines(conditions, metric)]
    return result | {
        "configuration": settings or {},
        "outcome": {f"{was} -> {now}": n for (was, now), n in outcomes.items()},
        "identical": same,
        "metrics": metrics,
        "conditions": conditions,
        "lines": lines,
    }


def _missing(mine: Mapping[Key, Row], its: Mapping[Key, Row]) -> dict[str, int]:
    """Label -> number of own cells that are not in the other table."""
    missing = Counter(key[1] for key in mine if key not in its)
    labels = contestant_labels(list(dict.fromkeys(key[1] for key in mine)))
    return {labels[contestant]: n for contestant, n in missing.items()}


def _equal(a: Row, b: Row) -> bool:
    return all(a[name] == b[name] or (a[name] != a[name] and b[name] != b[name]) for name in EXACT)


def _settings(a: Path, b: Path, pairs: Sequence[tuple[Row, Row]]) -> dict[str, list[Any]] | None:
    """Settings that differ between the cells of a pair, one pair per condition and contestant; None without cells."""
    first: dict[Key, tuple[Row, Row]] = {}
    for pair in pairs:
        first.setdefault((condition_of(pair[0]), contestant_of(pair[0])), pair)
    stores = CellStore(a), CellStore(b)
    found: dict[str, dict[str, list[Any]]] = {}
    read = 0
    for pair in list(first.values())[:MOST_CONFIGURATIONS]:
        try:
            records = [read_metadata(store.path(row["key"]), "flight") for store, row in zip(stores, pair, strict=True)]
        except QuadexpError:  # a failed cell has no file
            continue
        read += 1
        for key, values in differing(*map(record_of, records)).items():
            found.setdefault(key, {})[repr(values)] = values
    made: dict[str, list[Any]] = {}
    for key, several in found.items():
        made[key] = next(iter(several.values()))
        if len(several) > 1:
            made[key] = [" | ".join(sorted({str(values[i]) for values in several.values()})) or ABSENT for i in (0, 1)]
    return made if read else None


def _contestants(
    both: Mapping[Key, tuple[Row, Row]], labels: Mapping[Any, str], metric: str, confidence: float
) -> list[dict[str, Any]]:
    """For each contestant: completed flights, means of a and b over the common flights, and b against a."""
    ended: dict[Any, set[Any]] = {contestant: set() for contestant in labels}
    for (condition, contestant, seed), (x, y) in both.items():
        if x["outcome"] == y["outcome"] == "ok":
            ended[contestant].add((condition, seed))
    compared, shared = common(ended)
    made = []
    for contestant, label in labels.items():
        pairs = {key[::2]: pair for key, pair in both.items() if key[1] == contestant}
        own = [pair for at, pair in pairs.items() if at in ended[contestant]]
        beyond = ended[contestant] - (shared if contestant in compared else frozenset())
        well = [pair for at, pair in pairs.items() if at in ended[contestant] - beyond]
        kept = [(condition, *pair) for (condition, seed), pair in pairs.items() if (condition, seed) not in beyond]
        rows = [
            dict(row, controller=side, model="", variant=condition[4])
            for condition, *pair in kept
            for side, row in zip("ab", pair, strict=True)
        ]
        (pooled,) = overall(rows, metric=metric, baseline="a", confidence=confidence)
        left_out = [pooled.left_out, f"{len(beyond)} not completed by all" if beyond else ""]
        made.append(
            {
                "label": label,
                "cells": len(pairs),
                "flown": {
                    s: [sum(p[i]["outcome"] == "ok" for p in pairs.values()), len(pairs)] for i, s in enumerate("ab")
                },
                **change(*_means(well, metric)),
                "pairs": pooled.pairs,
                "seeds": pooled.units,
                "left_out": ", ".join(filter(None, left_out)),
                "ratio": -pooled.reduction,
                "ratio_low": -pooled.reduction_high,
                "ratio_high": -pooled.reduction_low,
                "p": pooled.p,
                "p_least": pooled.p_least,
                "own": {"pairs": len(own), **change(*_means(own, metric))},
            }
        )
    corrected = holm(np.array([one["p"] for one in made]))
    tests = int(np.count_nonzero(~np.isnan(corrected)))
    for one, p in zip(made, corrected, strict=True):
        one |= {"p_holm": float(p), "distinguishable": bool(p < 1 - confidence)}
        one["testable"] = bool(tests * float(str(one["p_least"])) < 1 - confidence)
    return made


def _means(pairs: Sequence[tuple[Row, Row]], metric: str) -> list[float]:
    return [sum(pair[i][metric] for pair in pairs) / len(pairs) if pairs else math.nan for i in (0, 1)]


def _conditions(both: Mapping[Key, tuple[Row, Row]], labels: Mapping[Any, str], metric: str) -> list[dict[str, Any]]:
    """Means over the seeds that completed on both sides, for every condition and contestant."""
    groups: dict[Key, list[tuple[Row, Row]]] = {}
    for key, (x, y) in both.items():
        if x["outcome"] == y["outcome"] == "ok":
            groups.setdefault(key[:2], []).append((x, y))
    names = ("plant", "vehicle", "trajectory", "speed", "setting")
    return [
        {**dict(zip(names, condition, strict=True)), "label": labels[who], **change(*_means(pairs, metric))}
        for (condition, who), pairs in groups.items()
    ]


def _metric_lines(metrics: Sequence[Mapping[str, Any]], metric: str) -> list[str]:
    factor, unit = SHOWN[metric]
    heading = [f"{TITLES[metric]} ({unit})", "flown a", "flown b", "pairs", "seeds", "a", "b", "b - a", "ratio"]
    rows, left_out, own = [], [], []
    for one in metrics:
        limits = "" if math.isnan(one["ratio_low"]) else f" [{one['ratio_low']:+.3g}, {one['ratio_high']:+.3g}]"
        ratio = relative(one["ratio"]) + ("" if one["ratio"] == 0 or math.isnan(one["ratio"]) else limits)
        verdict = "not distinguishable" if one["testable"] else f"{count(one['seeds'], 'seed')} cannot tell"
        verdict = ("smaller" if one["ratio"] < 0 else "larger") if one["distinguishable"] else verdict
        verdict = {"-": "-", "same": "the same"}.get(ratio, verdict)
        flown = [f"{k} of {n}" for k, n in (one["flown"][side] for side in "ab")]
        numbers = [number(factor * one[name]) for name in ("a", "b", "difference")]
        p = p_value(one["p_holm"] if one["testable"] else math.nan)
        rows.append([one["label"], *flown, str(one["pairs"]), str(one["seeds"]), *numbers, ratio, p, verdict])
        if one["left_out"]:
            left_out.append(f"  {one['label']}: left out {re.sub(r' by a(?=,|$)', ' in a', one['left_out'])}")
        if one["own"]["pairs"] > one["pairs"]:
            means = " and ".join(number(factor * one["own"][side]) for side in "ab")
            own.append(f"  {one['label']}: over all {one['own']['pairs']} that it completed in both: {means} {unit}")
    return Table([*heading, "p (Holm)", "b is"], rows, notes=[*left_out, *own]).lines()


def _condition_lines(conditions: Sequence[Mapping[str, Any]], metric: str) -> list[str]:
    factor, unit = SHOWN[metric]
    changed = [one for one in conditions if one["difference"]]
    changed.sort(key=lambda one: -abs(one["relative"]) if not math.isnan(one["relative"]) else -math.inf)
    lines = []
    for one in changed[:MOST_CONDITIONS]:
        world = f"@{one['plant']}" if len({c["plant"] for c in conditions}) > 1 else ""
        where = " ".join(filter(None, (one["trajectory"], speed_text(one["speed"]), one["setting"], world)))
        numbers = f"{number(factor * one['a'])} -> {number(factor * one['b'])} {unit}"
        lines.append(f"  {one['label']} on {where}: {numbers} ({relative(one['relative'])})")
    rest = len(changed) - len(lines)
    return lines + ([f"  and {rest} more (--json has all)"] if rest > 0 else [])


def results_beside(paths: Sequence[Path], names: Sequence[str]) -> dict[str, Any]:
    """The means of all of them side by side: `names`, `metrics` and `tables`."""
    metric, rows = results_means(paths)
    factor, unit = SHOWN[metric]
    lines = [[label, *(number(factor * v) for v in means), str(flights)] for label, (means, flights) in rows.items()]
    table = Table([f"{TITLES[metric]} ({unit})", *names, "flights"], lines, notes=[NOTE])
    return {"names": names, "metrics": {label: means for label, (means, _) in rows.items()}, "tables": [table]}


def results_means(paths: Sequence[Path]) -> tuple[str, dict[str, tuple[list[float], int]]]:
    """The metric of the first, and label of a contestant -> its mean in each of the results (m) and over how many
    flights; NaN where there is no common one."""
    tables = [read_table(path / RESULTS_FILE, "results") for path in paths]
    metric = tables[0][1].get("metric", "mean_error")
    sides = matched(*(from_columns(columns) for columns, _ in tables))
    shared_keys = [key for key in sides[0] if all(key in side for side in sides)]
    ended: dict[Any, set[Any]] = {contestant: set() for _, contestant, _ in shared_keys}
    for condition, contestant, seed in shared_keys:
        if all(side[condition, contestant, seed]["outcome"] == "ok" for side in sides):
            ended[contestant].add((condition, seed))
    compared, shared = common(ended)
    labels = contestant_labels(list(ended))
    found = {}
    for contestant, label in labels.items():
        own = sorted(shared, key=str) if contestant in compared else []
        rows = [[side[condition, contestant, seed] for condition, seed in own] for side in sides]
        means = [sum(float(row[metric]) for row in flown) / len(flown) if flown else math.nan for flown in rows]
        found[label] = means, len(own)
    return metric, found
