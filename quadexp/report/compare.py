"""What differs between flights, results or checkpoints: in configuration, in outcome, in figures.

Every other one is compared with the first, b with a: difference = b - a, relative = 100 (b - a) / a (%).

Flights of two results are paired by condition, contestant and seed. Errors are over the flights that all contestants
ended well in both (pairing.py): b is compared with a as a contestant is with a baseline in statistics.py, by a mean
ratio over the seeds with its interval and a paired permutation test; b is "not distinguishable" if that is not
significant, and "n seeds cannot tell" where it could not be.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError, UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, read_metadata, read_table
from quadexp.physics.state import POSITION
from quadexp.report.compare_many import beside
from quadexp.report.compare_parts import FIGURES, checkpoint_record, flat, matched, parameters, record_of
from quadexp.report.inference import holm
from quadexp.report.metrics import METRICS, SHOWN
from quadexp.report.pairing import common, condition_of, contestant_labels, contestant_of
from quadexp.report.result_rows import from_columns
from quadexp.report.statistics import overall
from quadexp.report.summary import MODEL_FILE, RESULTS_FILE, summarise
from quadexp.report.table import Table
from quadexp.report.tables import TITLES
from quadexp.report.text import count, number, p_value, relative, speed_text

ABSENT = "-"
MOST_LINES = 16  # settings shown; --json has all
MOST_CONFIGURATIONS = 40  # cells whose configurations are read on either side
MOST_DETAILED = 4  # others that are compared with the first one by one, in the lines
MOST_CONDITIONS = 6  # lines of conditions, the largest changes first
MEASURED = ("solve_time",)  # columns that two runs of one flight may differ in
EXACT = [name for name in METRICS if not name.startswith("solve_time")]  # the same for the same flight
Row = Mapping[str, Any]
Key = tuple[Any, ...]  # condition, contestant, seed


def compare(first: str | Path, *others: str | Path) -> dict[str, Any]:
    """What differs; `lines` is for people, the rest for programs (SI units).

    With several others: {"kind", "together": all side by side, "comparisons": one per other, "lines"}.
    Raises UsageError if something is not there, not of the same kind, or of a kind that cannot be compared.
    """
    paths = [Path(path) for path in (first, *others)]
    kinds = [kind_of(path) for path in paths]
    for path, kind in zip(paths, kinds, strict=True):
        if kind not in KINDS:
            raise UsageError(f"{path}: holds {kind}; flights, results and checkpoints can be compared")
        if kind != kinds[0]:
            named = [k if k == "results" else f"a {k}" for k in (kinds[0], kind)]
            raise UsageError(f"cannot compare {named[0]} ({first}) with {named[1]} ({path}): give two of one kind")
    made = []
    for other in paths[1:]:
        found = KINDS[kinds[0]](paths[0], other)
        made.append({"kind": kinds[0], "a": str(first), "b": str(other), **found})
    if len(made) == 1:
        return made[0]
    found = beside(kinds[0], paths)
    together = [line for table in found["tables"] for line in ("", *table.lines())][1:]
    each = [line for one in made for line in ("", *one["lines"])] if len(made) <= MOST_DETAILED else []
    return {
        "kind": kinds[0],
        "together": {k: v for k, v in found.items() if k != "tables"},
        "comparisons": [{k: v for k, v in one.items() if k != "lines"} for one in made],
        "lines": [*together, *each],
    }


def compare_tables(first: str | Path, *others: str | Path) -> list[Table]:
    """All side by side, as tables; raises as `compare`, which comes before."""
    paths = [Path(path) for path in (first, *others)]
    return list(beside(kind_of(paths[0]), paths)["tables"])


def kind_of(path: Path) -> str:
    """ "flight", "results", "checkpoint", or another kind that the file records."""
    if not path.exists():
        raise UsageError(f"{path}: no such file or folder")
    if path.name == MODEL_FILE or (path / MODEL_FILE).is_file():
        return "checkpoint"
    if path.is_dir():
        if not (path / RESULTS_FILE).is_file():
            raise UsageError(f"{path}: neither a checkpoint ({MODEL_FILE}) nor results ({RESULTS_FILE}) in this folder")
        return "results"
    return read_metadata(path)["kind"]


# -- settings and figures --


def differing(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Dotted key -> [value in a, value in b], for those that differ; "-" for a missing key."""
    left, right = flat(a), flat(b)
    values = {key: [left.get(key, ABSENT), right.get(key, ABSENT)] for key in dict.fromkeys([*left, *right])}
    return {key: pair for key, pair in values.items() if pair[0] != pair[1]}


def change(a: Any, b: Any) -> dict[str, float]:
    """a, b, difference b - a, relative (%), NaN if not defined."""
    a, b = (math.nan if value is None else float(value) for value in (a, b))
    ratio = 100 * (b - a) / a if a else (0.0 if a == b else math.nan)
    return {"a": a, "b": b, "difference": b - a, "relative": ratio}


def setting_lines(settings: Mapping[str, list[Any]]) -> list[str]:
    """The settings that differ, a line each, at most MOST_LINES."""
    if not settings:
        return ["configuration  the same"]

    def short(value: Any) -> str:
        text = "null" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
        return text if len(text) <= 36 else text[:33] + "..."

    rows = [[f"  {key}", *map(short, pair)] for key, pair in list(settings.items())[:MOST_LINES]]
    text = count(len(settings), "setting") + (" differ" if len(settings) > 1 else " differs")
    rest = len(settings) - len(rows)
    lines = Table(rows[0], rows[1:], left=frozenset(range(3))).lines()
    return [f"configuration  {text}", *lines, *([f"  and {rest} more (--json has all)"] if rest else [])]


def figure_lines(figures: Iterable[tuple[str, Mapping[str, float], float]]) -> list[str]:
    """A table of changes. figures: name, change, and the factor it is printed with."""
    rows = [
        [name, *(number(factor * one[key]) for key in ("a", "b", "difference")), relative(one["relative"])]
        for name, one, factor in figures
    ]
    return Table(["", "a", "b", "b - a", "relative"], rows).lines()


# -- flights --


def compare_flights(a: Path, b: Path) -> dict[str, Any]:
    """Two flights: settings, outcome, metrics, and the distance between the paths."""
    flights = [read_flight(path, check=False) for path in (a, b)]
    rows = [flight.metadata.get("row") or {} for flight in flights]
    for path, row in zip((a, b), rows, strict=True):
        if not row:
            raise UsageError(f"{path}: a flight without a result row (a recorded one?): it cannot be compared")
    settings = differing(*(record_of(flight.metadata) for flight in flights))
    metrics = {name: change(rows[0].get(name), rows[1].get(name)) for name in FIGURES}
    paths = _paths(*flights)
    lines, ended = [], []
    for side, path, row, flight in zip("ab", (a, b), rows, flights, strict=True):
        speed = f" at {text}" if (text := speed_text(row["speed"])) else ""
        about = f"{row['controller']} on {row['trajectory']}{speed}, {row['plant']}, seed {row['seed']}"
        lines.append(f"{side}  {path}: {about}")
        cause = flight.metadata.get("cause")
        ended.append(row["outcome"] + (f" ({cause})" if cause else ""))
    lines += ["", *setting_lines(settings), "", f"outcome  {' -> '.join(dict.fromkeys(ended))}", ""]
    named = ((f"{name} ({unit})", metrics[name], factor) for name, (factor, unit) in FIGURES.items())
    lines += [*figure_lines(named), "", f"samples  {paths['text']}"]
    outcome = [row["outcome"] for row in rows]
    return {"configuration": settings, "outcome": outcome, "metrics": metrics, "paths": paths, "lines": lines}


def _paths(a: Flight, b: Flight) -> dict[str, Any]:
    """The distance between two flights at the same times, as far as they have the same times."""
    samples = min(len(a), len(b))
    if samples == 0 or not np.array_equal(a.t[:samples], b.t[:samples]):
        return {"common": 0, "identical": False, "text": "not at the same times: the paths are not compared"}
    names = [name for name in a.columns if name in b.columns and name not in MEASURED]
    same = len(a) == len(b) and set(a.columns) == set(b.columns)
    if same and all(np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f") for name in names):
        text = f"all {samples} are the same to the last bit, solve times apart"
        return {"common": samples, "identical": True, "text": text}
    apart = np.linalg.norm(a.state[:samples, POSITION] - b.state[:samples, POSITION], axis=1)
    at = int(np.argmax(apart))
    length = "" if len(a) == len(b) else f" of {len(a)} and {len(b)}"
    text = f"at most {1e3 * apart[at]:.4g} mm apart, at t = {a.t[at]:.2f} s ({samples} common samples{length})"
    return {"common": samples, "identical": False, "distance": float(apart[at]), "t": float(a.t[at]), "text": text}


# -- checkpoints --


def compare_checkpoints(a: Path, b: Path) -> dict[str, Any]:
    """Two checkpoints: their data and settings, their parameters, and their held-out errors."""
    found = [summarise(path) for path in (a, b)]
    settings = differing(*map(checkpoint_record, found))
    left, right = (parameters(path, one) for path, one in zip((a, b), found, strict=True))
    metrics = {name: change(left[name], right[name]) for name in left if name in right}
    lines = [f"a  {a}: {found[0]['kind']}", f"b  {b}: {found[1]['kind']}", "", *setting_lines(settings), ""]
    lines += figure_lines((name, one, 1.0) for name, one in metrics.items())
    only = {side: [n for n in mine if n not in its] for side, mine, its in (("a", left, right), ("b", right, left))}
    lines += [f"only in {side}: {', '.join(missing)}" for side, missing in only.items() if missing]
    return {"configuration": settings, "metrics": metrics, "only": only, "lines": lines}


# -- results --


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
    """For each contestant: flights that ended well, means of a and b over the common flights, and b against a."""
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
        left_out = [pooled.left_out, f"{len(beyond)} not ended well by all" if beyond else ""]
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
    """Means over the seeds that ended well on both sides, for every condition and contestant."""
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
            own.append(f"  {one['label']}: over all {one['own']['pairs']} that it ended well in both: {means} {unit}")
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


KINDS = {"flight": compare_flights, "results": compare_results, "checkpoint": compare_checkpoints}
