"""Two tables of results: what differs in configuration, in outcome, and in the figures of the cells that both have.

Cells are paired by condition, contestant and seed. First stands how many flights of each ended well. Errors are over
the flights that all contestants ended well in both (common.py): b is compared with a as a contestant is with a baseline
in overall.py, by a mean ratio with its interval and a paired permutation test; where that shows no difference, b is
"not distinguishable". Means over all flights that a contestant itself ended well in both stand beside it.
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
from quadexp.report.common import common
from quadexp.report.differences import ABSENT, change, differing, record_of, said_relative, setting_lines
from quadexp.report.inference import holm
from quadexp.report.metrics import METRICS, SHOWN
from quadexp.report.overall import Overall, overall
from quadexp.report.pairing import condition_of, contestant_labels, contestant_of
from quadexp.report.summary import RESULTS_FILE
from quadexp.report.tables import TITLES, from_columns
from quadexp.report.wording import number, said_p

MOST_CONFIGURATIONS = 40  # cells whose configurations are read on either side
MOST_CONDITIONS = 6  # lines of conditions, the largest changes first
EXACT = [name for name in METRICS if not name.startswith("solve_time")]  # the same for the same flight

Row = Mapping[str, Any]
Key = tuple[Any, ...]


def compare_results(a: Path, b: Path) -> dict[str, Any]:
    """Two results folders; see the module. The metric is a's."""
    tables = [read_table(path / RESULTS_FILE, "results") for path in (a, b)]
    metric = tables[0][1].get("metric", "mean_error")
    confidence = tables[0][1].get("confidence", 0.95)
    left, right = _matched(*(from_columns(columns) for columns, _ in tables))
    both = [key for key in left if key in right]
    result: dict[str, Any] = {"kind": "results", "a": str(a), "b": str(b), "metric": metric, "pairs": len(both)}
    lines = [f"a  {a}: {len(left)} cells", f"b  {b}: {len(right)} cells", ""]
    result["only"] = {"a": _described(left, right), "b": _described(right, left)}
    for side, only in result["only"].items():
        if only:
            lines.append(f"only in {side}  " + ", ".join(f"{count} {label}" for label, count in only.items()))
    if not both:
        lines.append("no cell is in both: nothing to compare")
        return result | {"configuration": {}, "outcome": {}, "metrics": [], "lines": lines}
    settings, note = _settings(a, b, [(left[key], right[key]) for key in both])
    result["configuration"] = settings
    lines += [note] if note else setting_lines(settings)
    lines.append("")
    outcomes = Counter((left[key]["outcome"], right[key]["outcome"]) for key in both)
    result["outcome"] = {f"{was} -> {now}": count for (was, now), count in outcomes.items()}
    lines.append("outcome  " + ", ".join(f"{n} {x if x == y else f'{x} -> {y}'}" for (x, y), n in outcomes.items()))
    same = sum(_identical(left[key], right[key]) for key in both)
    result["identical"] = same
    lines.append(f"same     {same} of {len(both)} pairs are the same to the last bit, measured times apart")
    result["metrics"] = metrics = _contestants(left, right, both, metric, confidence)
    result["conditions"] = conditions = _conditions(left, right, both, metric)
    lines += ["", *_table(metrics, metric)]
    if same < len(both):
        lines += ["", "largest changes", *_condition_lines(conditions, metric)]
    return result | {"lines": lines}


def _matched(a: Sequence[Row], b: Sequence[Row]) -> tuple[dict[Key, Row], dict[Key, Row]]:
    """Rows by condition, contestant and seed; a checkpoint's path takes part only where it tells contestants apart."""
    seen: dict[tuple[int, str, str], set[str]] = {}
    for side, rows in enumerate((a, b)):
        for controller, model, variant in map(contestant_of, rows):
            seen.setdefault((side, controller, variant), set()).add(model)
    several = {who[1:] for who, models in seen.items() if len(models) > 1}
    made: tuple[dict[Key, Row], dict[Key, Row]] = ({}, {})
    for found, rows in zip(made, (a, b), strict=True):
        for row in rows:
            controller, model, variant = contestant_of(row)
            model = model if (controller, variant) in several else ""
            found[condition_of(row), (controller, model, variant), row["seed"]] = row
    return made


def _described(mine: Mapping[Key, Row], its: Mapping[Key, Row]) -> dict[str, int]:
    """Label -> how many cells of mine are not in the other."""
    missing = Counter(key[1] for key in mine if key not in its)
    labels = contestant_labels(list(dict.fromkeys(key[1] for key in mine)))
    return {labels[contestant]: count for contestant, count in missing.items()}


def _identical(a: Row, b: Row) -> bool:
    def same(x: Any, y: Any) -> bool:
        return x == y or (x != x and y != y)  # NaN is NaN

    return a["outcome"] == b["outcome"] and all(same(a[name], b[name]) for name in EXACT)


def _settings(a: Path, b: Path, pairs: Sequence[tuple[Row, Row]]) -> tuple[dict[str, list[Any]], str]:
    """Settings that differ between the cells of a pair, looked up in one pair a condition and contestant."""
    first: dict[Key, tuple[Row, Row]] = {}
    for pair in pairs:
        first.setdefault((condition_of(pair[0]), contestant_of(pair[0])), pair)
    stores = CellStore(a), CellStore(b)
    found: dict[str, Counter[tuple[str, str]]] = {}
    values: dict[tuple[str, str], list[Any]] = {}
    looked = 0
    for pair in list(first.values())[:MOST_CONFIGURATIONS]:
        try:
            records = [read_metadata(store.path(row["key"]), "flight") for store, row in zip(stores, pair, strict=True)]
        except QuadexpError:  # a failed cell has no file
            continue
        looked += 1
        for key, both in differing(*map(record_of, records)).items():
            text = repr(both[0]), repr(both[1])
            values[text] = both
            found.setdefault(key, Counter())[text] += 1
    if not looked:
        return {}, "configuration  not compared: the cells are not beside both tables"
    made: dict[str, list[Any]] = {}
    for key, counts in found.items():
        if len(counts) == 1:
            made[key] = values[next(iter(counts))]
        else:
            sides = [list(dict.fromkeys(str(values[text][i]) for text in counts)) for i in (0, 1)]
            made[key] = [" | ".join(sorted(side)) or ABSENT for side in sides]
    return made, ""


def _contestants(
    left: Mapping[Key, Row], right: Mapping[Key, Row], both: Sequence[Key], metric: str, confidence: float
) -> list[dict[str, Any]]:
    """For each contestant: flights that ended well, means of a and b over the common flights, and b against a."""
    labels = contestant_labels(list(dict.fromkeys(key[1] for key in both)))
    ended: dict[Any, set[Any]] = {contestant: set() for contestant in labels}
    for key in both:
        if left[key]["outcome"] == right[key]["outcome"] == "ok":
            ended[key[1]].add((key[0], key[2]))
    compared, shared = common(ended)
    made = []
    for contestant, label in labels.items():
        asked = [key for key in both if key[1] == contestant]
        own = [key for key in asked if (key[0], key[2]) in ended[contestant]]
        well = [key for key in own if contestant in compared and (key[0], key[2]) in shared]
        beyond = set(own) - set(well)
        keys = [key for key in asked if key not in beyond]
        rows = [dict(left[key], controller="a", model="", variant=key[0][4]) for key in keys]
        rows += [dict(right[key], controller="b", model="", variant=key[0][4]) for key in keys]
        (pooled,) = overall(rows, metric=metric, baseline="a", confidence=confidence)
        flown = {
            side: [sum(rows_of[key]["outcome"] == "ok" for key in asked), len(asked)]
            for side, rows_of in (("a", left), ("b", right))
        }
        against = _against(pooled)
        if beyond:
            against["left_out"] = ", ".join(filter(None, [against["left_out"], f"{len(beyond)} not ended well by all"]))
        means = change(_mean(left, well, metric), _mean(right, well, metric))
        all_own = change(_mean(left, own, metric), _mean(right, own, metric))
        made.append({"label": label, "cells": len(asked), "flown": flown, **means, **against})
        made[-1]["own"] = {"pairs": len(own), **all_own}
    for one, p in zip(made, holm(np.array([one["p"] for one in made])), strict=True):
        one["p_holm"] = float(p)
        one["distinguishable"] = bool(p < 1 - confidence)
    return made


def _mean(rows: Mapping[Key, Row], keys: Sequence[Key], metric: str) -> float:
    return sum(rows[key][metric] for key in keys) / len(keys) if keys else math.nan


def _against(pooled: Overall) -> dict[str, Any]:
    """b against a: mean ratio over the conditions as a percentage, negative where b is smaller."""
    return {
        "pairs": pooled.pairs,
        "left_out": pooled.left_out,
        "ratio": -pooled.reduction,
        "ratio_low": -pooled.reduction_high,
        "ratio_high": -pooled.reduction_low,
        "p": pooled.p,
    }


def _conditions(
    left: Mapping[Key, Row], right: Mapping[Key, Row], both: Sequence[Key], metric: str
) -> list[dict[str, Any]]:
    """Means over the seeds that ended well on both sides, for every condition and contestant."""
    labels = contestant_labels(list(dict.fromkeys(key[1] for key in both)))
    groups: dict[Key, list[Key]] = {}
    for key in both:
        if left[key]["outcome"] == right[key]["outcome"] == "ok":
            groups.setdefault(key[:2], []).append(key)
    made = []
    for (condition, contestant), keys in groups.items():
        means = [sum(side[key][metric] for key in keys) / len(keys) for side in (left, right)]
        names = ("plant", "vehicle", "trajectory", "speed", "setting")
        made.append({**dict(zip(names, condition, strict=True)), "label": labels[contestant], **change(*means)})
    return made


def _table(metrics: Sequence[Mapping[str, Any]], metric: str) -> list[str]:
    factor, unit = SHOWN[metric]
    rows = [
        [f"{TITLES[metric]} ({unit})", "flown a", "flown b", "pairs", "a", "b", "b - a", "ratio", "p (Holm)", "b is"]
    ]
    for one in metrics:
        numbers = [number(factor * one[name]) for name in ("a", "b", "difference")]
        limits = "" if math.isnan(one["ratio_low"]) else f" [{one['ratio_low']:+.3g}, {one['ratio_high']:+.3g}]"
        ratio = "-" if math.isnan(one["ratio"]) else "same" if one["ratio"] == 0 else f"{one['ratio']:+.3g} %{limits}"
        flown = [f"{k} of {n}" for k, n in (one["flown"][side] for side in "ab")]
        rows.append([one["label"], *flown, str(one["pairs"]), *numbers, ratio, said_p(one["p_holm"]), _said(one)])
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [f"{text:>{width}}" for text, width in zip(row[1:], widths[1:], strict=True)]
        lines.append("  ".join([f"{row[0]:<{widths[0]}}", *cells]))
    left_out = [
        f"  {one['label']}: left out {re.sub(r' by a(?=,|$)', ' in a', one['left_out'])}"
        for one in metrics
        if one["left_out"]
    ]
    own = [
        f"  {one['label']}: over all {one['own']['pairs']} that it ended well in both:"
        f" {number(factor * one['own']['a'])} and {number(factor * one['own']['b'])} {unit}"
        for one in metrics
        if one["own"]["pairs"] > one["pairs"]
    ]
    return lines + left_out + own


def _said(one: Mapping[str, Any]) -> str:
    """Whether b is smaller or larger, beyond chance."""
    if math.isnan(one["ratio"]):
        return "-"
    if one["ratio"] == 0:
        return "the same"
    return ("smaller" if one["ratio"] < 0 else "larger") if one["distinguishable"] else "not distinguishable"


def _condition_lines(conditions: Sequence[Mapping[str, Any]], metric: str) -> list[str]:
    factor, unit = SHOWN[metric]
    changed = [one for one in conditions if one["difference"]]
    changed.sort(key=lambda one: -abs(one["relative"]) if not math.isnan(one["relative"]) else -math.inf)
    lines = []
    for one in changed[:MOST_CONDITIONS]:
        speed = "" if one["speed"] is None else f" {one['speed']:g} m/s"
        world = f"@{one['plant']}" if len({c["plant"] for c in conditions}) > 1 else ""
        where = " ".join(part for part in (f"{one['trajectory']}{speed}", one["setting"], world) if part)
        numbers = f"{number(factor * one['a'])} -> {number(factor * one['b'])} {unit}"
        lines.append(f"  {one['label']} on {where}: {numbers} ({said_relative(one['relative'])})")
    rest = len(changed) - len(lines)
    return lines + ([f"  and {rest} more (--json has all)"] if rest > 0 else [])
