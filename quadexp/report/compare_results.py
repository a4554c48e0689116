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
from quadexp.report.frame import flat, setting_text
from quadexp.report.inference import holm
from quadexp.report.metrics import METRICS, SHOWN
from quadexp.report.pairing import common, condition_of, contestant_labels, contestant_of, is_flown, setting_pairs
from quadexp.report.result_rows import from_columns
from quadexp.report.statistics import overall
from quadexp.report.summary import RESULTS_FILE
from quadexp.report.table import Table
from quadexp.report.tables import TITLES
from quadexp.report.text import count, number, p_value, relative, speed_text

ABSENT = "-"
MOST_LINES = 16  # settings shown; --json has all
MOST_LETTERS = 36  # of a value
MOST_CONFIGURATIONS = 40  # cells whose configurations are read on either side
MOST_CONDITIONS = 6  # lines of conditions, the largest changes first
EXACT = [name for name in METRICS if not name.startswith("solve_time")]  # the same for the same flight
NOTE = "means over the flights that all of them completed in every one of these results"

Row = Mapping[str, Any]
Key = tuple[Any, ...]  # condition, contestant, seed


def record_of(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """What decides a flight: its configuration, the content of its checkpoint, and the versions that flew it."""
    git = (metadata.get("provenance") or {}).get("git") or {}
    return {
        **(metadata.get("config") or {}),
        "model_sha256": (metadata.get("model_sha256") or "")[:12],
        "versions": {
            **(metadata.get("versions") or {}),
            "sources": metadata.get("sources") or "",
            "commit": (git.get("commit") or "")[:10],
        },
        "backend": metadata.get("backend", ""),
    }


def differing(*records: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Dotted key -> its value in each, for those that differ; "-" for a missing key."""
    sides = list(map(flat, records))
    values = {key: [side.get(key, ABSENT) for side in sides] for side in sides for key in side}
    return {key: own for key, own in values.items() if any(value != own[0] for value in own)}


def change(a: Any, b: Any) -> dict[str, float]:
    """a, b, difference b - a, relative (%), NaN if not defined."""
    a, b = (math.nan if value is None else float(value) for value in (a, b))
    ratio = 100 * (b - a) / a if a else (0.0 if a == b else math.nan)
    return {"a": a, "b": b, "difference": b - a, "relative": ratio}


def setting_table(settings: Mapping[str, Sequence[Any]], names: Sequence[str], indent: str = "") -> Table:
    """The settings that differ, a row each, at most MOST_LINES."""

    def short(value: Any) -> str:
        text = "null" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
        return text if len(text) <= MOST_LETTERS else f"{text[: MOST_LETTERS - 3]}..."

    rows = [[f"{indent}{key}", *map(short, values)] for key, values in list(settings.items())[:MOST_LINES]]
    notes = [f"{indent}and {len(settings) - len(rows)} more (--json has all)"] if len(settings) > len(rows) else []
    return Table([f"{indent}setting", *names], rows, left=frozenset(range(1 + len(names))), notes=notes)


def setting_lines(settings: Mapping[str, Sequence[Any]]) -> list[str]:
    """The settings that differ between a and b, a line each."""
    if not settings:
        return ["configuration  the same"]
    text = count(len(settings), "setting") + (" differ" if len(settings) > 1 else " differs")
    return [f"configuration  {text}", *setting_table(settings, "ab", "  ").lines()]


def matched(*tables: Sequence[Row]) -> list[dict[Key, Row]]:
    """Rows by condition, contestant and seed; with the checkpoint only where it distinguishes contestants."""
    contestants = ((side, who) for side, rows in enumerate(tables) for who in set(map(contestant_of, rows)))
    models = Counter((side, controller, variant) for side, (controller, _, variant) in contestants)
    several = {who[1:] for who, n in models.items() if n > 1}
    sides: list[dict[Key, Row]] = [{} for _ in tables]
    for rows, side in zip(tables, sides, strict=True):
        for row in rows:
            controller, model, variant = contestant_of(row)
            contestant = controller, model if (controller, variant) in several else "", variant
            side[condition_of(row), contestant, row["seed"]] = row
    return sides


def completed_in_all(sides: Sequence[Mapping[Key, Row]]) -> tuple[dict[Key, tuple[Row, ...]], set[Key]]:
    """The flights completed in all results, with a row of each; and those that all compared contestants completed."""
    both = {key: tuple(side[key] for side in sides) for key in sides[0] if all(key in side for side in sides)}
    flights = {key: rows for key, rows in both.items() if all(map(is_flown, rows))}
    by_contestant: dict[Any, set[Any]] = {who: set() for _, who, _ in both}
    for condition, who, seed in flights:
        by_contestant[who].add((condition, seed))
    compared, common_flights = common(by_contestant)
    return flights, {key for key in flights if key[::2] in common_flights and key[1] in compared}


def _mean(rows: Sequence[Row], metric: str) -> float:
    return sum(row[metric] for row in rows) / len(rows) if rows else math.nan


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
    settings = _settings(a, b, both)
    outcomes = Counter((x["outcome"], y["outcome"]) for x, y in both.values())
    same = sum(
        all(x[n] == y[n] or x[n] != x[n] and y[n] != y[n] for n in ("outcome", *EXACT)) for x, y in both.values()
    )
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
    missing = Counter(contestant for at, contestant, seed in mine if (at, contestant, seed) not in its)
    labels = contestant_labels(list(dict.fromkeys(contestant for _, contestant, _ in mine)))
    return {labels[contestant]: n for contestant, n in missing.items()}


def _settings(a: Path, b: Path, both: Mapping[Key, tuple[Row, Row]]) -> dict[str, list[Any]] | None:
    """Settings that differ between the cells of a pair, one pair per condition and contestant; None without cells."""
    first: dict[Key, tuple[Row, Row]] = {}
    for (condition, contestant, _), pair in both.items():
        first.setdefault((condition, contestant), pair)
    values: dict[str, dict[str, list[Any]]] | None = None
    for pair in list(first.values())[:MOST_CONFIGURATIONS]:
        try:
            files = (CellStore(root).path(row["key"]) for root, row in zip((a, b), pair, strict=True))
            records = [record_of(read_metadata(file, "flight")) for file in files]
        except QuadexpError:  # a failed cell has no file
            continue
        values = values or {}
        for key, sides in differing(*records).items():
            values.setdefault(key, {})[repr(sides)] = sides
    if values is None:
        return None
    every = {key: list(zip(*several.values(), strict=True)) for key, several in values.items()}
    return {
        key: [one[0] if len(one) == 1 else (" | ".join(sorted(set(map(str, one)))) or ABSENT) for one in sides]
        for key, sides in every.items()
    }


def _contestants(
    both: Mapping[Key, tuple[Row, Row]], labels: Mapping[Any, str], metric: str, confidence: float
) -> list[dict[str, Any]]:
    """For each contestant: completed flights, means of a and b over the common flights, and b against a."""
    flights, shared = completed_in_all([{key: pair[i] for key, pair in both.items()} for i in (0, 1)])
    made: list[dict[str, Any]] = []
    for contestant, label in labels.items():
        pairs = {key: pair for key, pair in both.items() if key[1] == contestant}
        own = [key for key in pairs if key in flights]
        kept = [key for key in pairs if key in shared or key not in flights]
        rows = [dict(both[key][i], controller="ab"[i], model="", variant=key[0][4]) for key in kept for i in (0, 1)]
        (pooled,) = overall(rows, metric=metric, baseline="a", confidence=confidence)
        beyond = len(pairs) - len(kept)
        left_out = [pooled.left_out, f"{beyond} not completed by all" if beyond else ""]
        means = (
            change(*(_mean([both[key][i] for key in some], metric) for i in (0, 1)))
            for some in ([key for key in own if key in shared], own)
        )
        made.append(
            {
                "label": label,
                "cells": len(pairs),
                "flown": {
                    s: [sum(is_flown(pair[i]) for pair in pairs.values()), len(pairs)] for i, s in enumerate("ab")
                },
                **next(means),
                "pairs": pooled.pairs,
                "seeds": pooled.units,
                "left_out": ", ".join(filter(None, left_out)),
                "ratio": -pooled.reduction,
                "ratio_low": -pooled.reduction_high,
                "ratio_high": -pooled.reduction_low,
                "p": pooled.p,
                "p_least": pooled.p_least,
                "own": {"pairs": len(own), **next(means)},
            }
        )
    corrected = holm(np.array([record["p"] for record in made]))
    tests = int(np.count_nonzero(~np.isnan(corrected)))
    for record, p in zip(made, corrected, strict=True):
        record |= {"p_holm": float(p), "distinguishable": bool(p < 1 - confidence)}
        record["testable"] = bool(tests * record["p_least"] < 1 - confidence)
    return made


def _conditions(both: Mapping[Key, tuple[Row, Row]], labels: Mapping[Any, str], metric: str) -> list[dict[str, Any]]:
    """Means over the seeds that completed on both sides, for every condition and contestant."""
    groups: dict[Key, list[tuple[Row, Row]]] = {}
    for key, pair in both.items():
        if all(map(is_flown, pair)):
            groups.setdefault(key[:2], []).append(pair)
    names = ("plant", "vehicle", "trajectory", "speed", "setting", "label")
    return [
        dict(zip(names, (*condition, labels[who]), strict=True))
        | change(*(_mean(side, metric) for side in zip(*pairs, strict=True)))
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
        where = " ".join(filter(None, (one["trajectory"], speed_text(one["speed"]), world)))
        where = ", ".join([where, *(setting_text(*pair) for pair in setting_pairs(one["setting"]))])
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
    flights, shared = completed_in_all(sides)
    in_all = [contestant for at, contestant, seed in sides[0] if all((at, contestant, seed) in side for side in sides)]
    means = {}
    for who, label in contestant_labels(list(dict.fromkeys(in_all))).items():
        own = [flights[key] for key in sorted(shared, key=lambda key: str(key[::2])) if key[1] == who]
        means[label] = [_mean([rows[i] for rows in own], metric) for i in range(len(paths))], len(own)
    return metric, means
