"""What differs between flights, results or checkpoints: in configuration, in outcome, in numbers.

Of two, b is compared with a: difference = b - a, relative = 100 (b - a) / a (%). Several are put side by side.

Flights of results are paired by condition, contestant and seed. Of two, a contestant's errors are over the flights that
it completed in both, whoever else did: b is compared with a as a contestant is with a baseline in statistics.py, by a
mean ratio over the seeds with its interval and the test of inference.py, over all conditions, corrected by Holm over
the contestants; b is "not distinguishable" if that is not significant, and "n seeds cannot tell" where it could not be.
Of several, means are over the flights that all contestants completed in all of them (pairing.py).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import QuadexpError, UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, read_metadata
from quadexp.names import distinct
from quadexp.parts.settings import flat
from quadexp.physics.state import norms
from quadexp.report.frame import read_results
from quadexp.report.inference import holm
from quadexp.report.metrics import METRICS, metric_of
from quadexp.report.pairing import (
    Row,
    Rows,
    causes_text,
    common,
    condition_of,
    contestant_labels,
    contestant_of,
    is_flown,
    is_invalid,
)
from quadexp.report.statistics import Statistic, overall
from quadexp.report.summary import held_out_rows, kind_of, summarise
from quadexp.report.table import Table
from quadexp.report.text import count, number, p_value, plain, relative, shown, speed_text

ABSENT = "-"
MOST_LINES = 16  # settings shown; --json has all
MOST_LETTERS = 36  # of a value
MOST_CONFIGURATIONS = 40  # cells whose configurations are read on either side
MEASURED = ("solve_time",)  # columns that two runs of one flight may differ in
FIGURES = (
    "mean_error",
    "rmse",
    "max_error",
    "attitude_rmse",
    "saturated_share",
    "command_change",
    "charge_used",
    "peak_speed",
    "duration",
    "solve_time_median",
    "solve_time_p99",
)
EXACT = [name for name in METRICS if not name.startswith("solve_time")]  # the same for the same flight
NOTE = "means over the flights that all of them completed in every one of these results"

Key = tuple[Any, ...]  # condition, contestant, seed
Report = dict[str, Any]  # by the names that --json has


class Side(NamedTuple):
    """A flight or a checkpoint. about: it in a line. settings: what decides it. numbers: by name. flight: None of a
    checkpoint."""

    about: str
    settings: Mapping[str, Any]
    numbers: Mapping[str, float]
    flight: Flight | None = None


def _flight(path: Path) -> Side:
    flight = read_flight(path, check=False)
    row = flight.metadata.get("row") or {}
    if not row:
        raise UsageError(f"{path}: a flight without a result row (a recorded one?): it cannot be compared")
    speed = f" at {text}" if (text := speed_text(row["speed"])) else ""
    about = f"{row['controller']} on {row['trajectory']}{speed}, {row['plant']}, seed {row['seed']}"
    numbers = {name: math.nan if row.get(name) is None else float(row[name]) for name in FIGURES}
    return Side(about, record_of(flight.metadata), numbers, flight)


def _checkpoint(path: Path) -> Side:
    """Its data, settings and features; its parameters, and the held-out errors of its report, if there is one."""
    summary = summarise(path)
    names = ("kind", "vehicle", "dataset", "settings", "versions")
    features = {name: {"features": output["features"]} for name, output in summary["outputs"].items()}
    numbers = {
        f"held-out RMSE of {row['output']} by {row['predictor']} ({row['unit']})": row["rmse"]
        for row in held_out_rows(path)
        if row["predictor"] != "zero"
    }
    numbers |= {f"drag_{axis} (1/s)": value for axis, value in zip("xyz", summary["drag"], strict=True)}
    for name, output in summary["outputs"].items():
        numbers[f"{name} signal"] = output["signal_std"]
        numbers[f"{name} noise"] = output["noise_std"]
        scales = zip(output["features"], output["lengthscale"], strict=True)
        numbers |= {f"{name} length of {feature}": scale for feature, scale in scales}
    return Side(summary["kind"], {**{name: summary[name] for name in names}, "outputs": features}, numbers)


SIDES = {"flight": _flight, "checkpoint": _checkpoint}


def compare(*files: str | Path) -> Report:
    """What differs; `lines` and `tables` are for people, the rest for programs (SI units).

    Raises UsageError if something is not there, not of the same kind, or of a kind that cannot be compared.
    """
    paths = [Path(path) for path in files]
    kinds = [kind_of(path) for path in paths]
    for path, kind in zip(paths, kinds, strict=True):
        if kind not in ("results", *SIDES):
            raise UsageError(f"{path}: holds {kind}; flights, results and checkpoints can be compared")
        if kind != kinds[0]:
            named = [k if k == "results" else f"a {k}" for k in (kinds[0], kind)]
            raise UsageError(f"cannot compare {named[0]} ({files[0]}) with {named[1]} ({path}): give two of one kind")
    report: Report = {"kind": kinds[0], "names": names_of(paths)}
    report |= {"a": str(files[0]), "b": str(files[1])} if len(paths) == 2 else {}
    report |= _results(paths) if kinds[0] == "results" else _sides([SIDES[kinds[0]](path) for path in paths], paths)
    if len(paths) > 2:
        report["lines"] = [line for table in report["tables"] for line in ("", *table.lines())][1:]
    return report


def names_of(paths: Sequence[Path]) -> list[str]:
    """A short name of each path; the whole paths where two names would be the same."""
    short = [path.stem if path.is_file() else path.resolve().name for path in paths]
    if len(set(short)) == len(short):
        return short
    return list(map(str, paths))


# --------------------------------------------------------------------------------------------------- settings, numbers
def record_of(metadata: Mapping[str, Any]) -> Report:
    """What decides a flight: its configuration, the content of its checkpoint, and the versions that flew it."""
    git = (metadata.get("provenance") or {}).get("git") or {}
    versions = {"sources": metadata.get("sources") or "", "commit": (git.get("commit") or "")[:10]}
    return {
        **(metadata.get("config") or {}),
        "model_sha256": (metadata.get("model_sha256") or "")[:12],
        "versions": (metadata.get("versions") or {}) | versions,
        "backend": metadata.get("backend", ""),
    }


def differing(*records: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Dotted key -> its value in each, for those that differ; "-" for a missing key."""
    sides = list(map(flat, records))
    values = {}
    for side in sides:
        for key in side:
            values[key] = [side.get(key, ABSENT) for side in sides]
    return {key: several for key, several in values.items() if any(value != several[0] for value in several)}


def change(a: float, b: float) -> dict[str, float]:
    """a, b, difference b - a, relative (%), NaN if not defined."""
    ratio = 100 * (b - a) / a if a else (0.0 if a == b else math.nan)
    return {"a": a, "b": b, "difference": b - a, "relative": ratio}


def _setting_table(settings: Mapping[str, Sequence[Any]], names: Sequence[str]) -> Table:
    """The settings that differ, a row each, at most MOST_LINES."""

    def short(value: Any) -> str:
        text = "null" if value is None else plain(value)
        if len(text) <= MOST_LETTERS:
            return text
        return f"{text[: MOST_LETTERS - 3]}..."

    rows = []
    for key, values in list(settings.items())[:MOST_LINES]:
        rows.append([key, *map(short, values)])
    notes = [f"and {len(settings) - len(rows)} more (--json has all)"] if len(settings) > len(rows) else []
    return Table(["setting", *names], rows, left=frozenset(range(1 + len(names))), notes=notes)


def _setting_lines(settings: Mapping[str, Sequence[Any]] | None) -> list[str]:
    """The settings that differ between a and b, a line each; None where they are not known."""
    if settings is None:
        return ["configuration  not compared: the cells are not beside both tables"]
    if not settings:
        return ["configuration  the same"]
    text = count(len(settings), "setting") + (" differ" if len(settings) > 1 else " differs")
    return [f"configuration  {text}", *(f"  {line}" for line in _setting_table(settings, "ab").lines())]


def _number_row(name: str, values: Sequence[float]) -> list[str]:
    """Name and values of a number in its unit."""
    factor, unit = shown(name)
    return [f"{name} ({unit})" if unit else name, *(number(factor * value) for value in values)]


# ------------------------------------------------------------------------------------------------ flights, checkpoints
def _sides(sides: Sequence[Side], paths: Sequence[Path]) -> Report:
    """Settings and numbers beside each other; of two flights also the outcome and the distance between the paths."""
    settings = differing(*(side.settings for side in sides))
    names = names_of(paths)
    metrics = {}
    for side in sides:
        for name in side.numbers:
            metrics[name] = [side.numbers.get(name, math.nan) for side in sides]
    tables = [_setting_table(settings, names)] if settings else []
    tables.append(Table(["figure", *names], [_number_row(name, values) for name, values in metrics.items()]))
    report: Report = {"configuration": settings, "metrics": metrics, "tables": tables}
    flights = [side.flight for side in sides if side.flight is not None]
    if flights:
        report["outcome"] = [flight.metadata["row"]["outcome"] for flight in flights]
    if len(sides) > 2:
        return report
    a, b = sides
    changes = {}
    for name, both in metrics.items():
        if name in a.numbers and name in b.numbers:
            changes[name] = change(*both)
    only = {"a": [n for n in a.numbers if n not in b.numbers], "b": [n for n in b.numbers if n not in a.numbers]}
    lines = [f"a  {paths[0]}: {a.about}", f"b  {paths[1]}: {b.about}", "", *_setting_lines(settings), ""]
    rows = []
    for name, found in changes.items():
        of_name = _number_row(name, [found["a"], found["b"], found["difference"]])
        rows.append([*of_name, relative(found["relative"])])
    if flights:
        causes = [f" ({cause})" if (cause := flight.metadata.get("cause")) else "" for flight in flights]
        ended = dict.fromkeys(map("".join, zip(report["outcome"], causes, strict=True)))
        lines += [f"outcome  {' -> '.join(ended)}", ""]
    lines += Table(["", "a", "b", "b - a", "relative"], rows).lines()
    lines += [f"only in {side}: {', '.join(missing)}" for side, missing in only.items() if missing]
    if flights:
        report["paths"] = _paths(*flights)
        lines += ["", f"samples  {report['paths']['text']}"]
    return report | {"metrics": changes, "only": only, "lines": lines}


def _paths(a: Flight, b: Flight) -> Report:
    """The distance between two flights at the times of the one with the longer period, as far as both flew."""
    names = [name for name in a.columns if name in b.columns and name not in MEASURED]
    same = len(a) == len(b) and set(a.columns) == set(b.columns)
    if same and all(np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f") for name in names):
        text = f"all {len(a)} are the same to the last bit, solve times apart"
        return {"common": len(a), "identical": True, "text": text}
    end = min(float(flight.t[-1]) if len(flight) else -math.inf for flight in (a, b))
    t = min((flight.t[flight.t <= end + 1e-9] for flight in (a, b)), key=len)
    if not len(t):
        return {"common": 0, "identical": False, "text": "one of them has none: the paths are not compared"}
    paths = []
    for flight in (a, b):
        paths.append(np.column_stack([np.interp(t, flight.t, flight[f"p_{i}"]) for i in "xyz"]))
    apart = norms(paths[0] - paths[1])
    at = int(np.argmax(apart))
    length = "" if len(a) == len(b) else f" of {len(a)} and {len(b)}"
    text = f"at most {1e3 * apart[at]:.4g} mm apart, at t = {t[at]:.2f} s ({len(t)} common samples{length})"
    return {"common": len(t), "identical": False, "distance": float(apart[at]), "t": float(t[at]), "text": text}


# ------------------------------------------------------------------------------------------------------------- results
def matched(*tables: Rows) -> list[dict[Key, Row]]:
    """Rows by condition, contestant and seed; with the checkpoint only where it distinguishes contestants."""
    contestants = ((side, who) for side, rows in enumerate(tables) for who in set(map(contestant_of, rows)))
    models = Counter((side, controller, variant) for side, (controller, _, variant) in contestants)
    several = {who[1:] for who, n in models.items() if n > 1}
    sides: list[dict[Key, Row]] = [{} for _ in tables]
    for rows, side in zip(tables, sides, strict=True):
        for row in rows:
            who = contestant_of(row)
            who = who if (who.controller, who.settings) in several else who._replace(model="")
            key = condition_of(row), who, row["seed"]
            if key not in side or not is_invalid(row):
                side[key] = row
    return sides


def _results(paths: Sequence[Path]) -> Report:
    """Results folders; see the module. The metric is the first one's."""
    _, tables, records = zip(*map(read_results, paths), strict=True)
    metric = records[0].get("metric", "mean_error")
    sides = matched(*tables)
    cells = {}
    for key in sides[0]:
        if all(key in side for side in sides):
            cells[key] = tuple(side[key] for side in sides)
    labels = contestant_labels(distinct(contestant for _, contestant, _ in cells))
    completed = [key for key, rows in cells.items() if all(map(is_flown, rows))]
    ended = {who: {(at, seed) for at, contestant, seed in completed if contestant == who} for who in labels}
    compared, shared = common(ended)
    means = {}
    texts = []
    for who, label in labels.items():
        kept = [cells[at, who, seed] for at, seed in sorted(shared, key=str)] if who in compared else []
        means[label] = [_mean([rows[i] for rows in kept], metric) for i in range(len(paths))]
        texts.append([label, *(number(metric_of(metric).factor * mean) for mean in means[label]), str(len(kept))])
    heads = [f"{metric_of(metric).title} ({metric_of(metric).unit})", *names_of(paths), "flights"]
    report = {"metric": metric, "metrics": means, "tables": [Table(heads, texts, notes=[NOTE])]}
    if len(paths) > 2:
        return report
    a, b = sides
    only = {"a": _missing(a, b), "b": _missing(b, a)}
    lines = [f"{name}  {path}: {len(side)} cells" for name, path, side in zip("ab", paths, sides, strict=True)] + [""]
    for name, missing in only.items():
        if missing:
            lines.append(f"only in {name}  {causes_text(missing)}")
    report["pairs"] = len(cells)
    report["only"] = only
    report["configuration"] = {}
    report["outcome"] = {}
    report["metrics"] = []
    if not cells:
        return report | {"lines": [*lines, "no cell is in both: nothing to compare"]}
    settings = _cell_settings(paths, cells)
    outcomes = Counter(tuple(row["outcome"] for row in pair) for pair in cells.values())
    changed = ", ".join(f"{n} {x if x == y else f'{x} -> {y}'}" for (x, y), n in outcomes.items())
    same = sum(
        all(x[n] == y[n] or (x[n] != x[n] and y[n] != y[n]) for n in ("outcome", *EXACT)) for x, y in cells.values()
    )
    metrics = _contestants(cells, labels, records[0])
    lines += [*_setting_lines(settings), "", f"outcome  {changed}"]
    lines += [f"same     {same} of {len(cells)} pairs are the same to the last bit, measured times apart", ""]
    report["outcome"] = {f"{was} -> {now}": n for (was, now), n in outcomes.items()}
    report["identical"] = same
    report["configuration"] = settings or {}
    report["metrics"] = metrics
    return report | {"lines": [*lines, *_metric_lines(metrics, metric)]}


def _mean(rows: Rows, metric: str) -> float:
    if rows:
        return sum(row[metric] for row in rows) / len(rows)
    return math.nan


def _missing(mine: Mapping[Key, Row], its: Mapping[Key, Row]) -> dict[str, int]:
    """Label -> number of own cells that are not in the other table."""
    labels = contestant_labels(distinct(contestant for _, contestant, _ in mine))
    return dict(Counter(labels[key[1]] for key in mine if key not in its))


def _cell_settings(roots: Sequence[Path], cells: Mapping[Key, tuple[Row, ...]]) -> dict[str, list[Any]] | None:
    """Settings that differ between the cells of a pair, one pair per condition and contestant; None without cells."""
    first: dict[Key, tuple[Row, ...]] = {}
    for key, pair in cells.items():
        first.setdefault(key[:2], pair)
    differ: dict[str, list[Report]] | None = None  # key -> of each side: text -> value
    for pair in list(first.values())[:MOST_CONFIGURATIONS]:
        try:
            files = (CellStore(root).path(row["key"]) for root, row in zip(roots, pair, strict=True))
            records = [record_of(read_metadata(file, "flight")) for file in files]
        except QuadexpError:  # a failed cell has no file
            continue
        differ = differ or {}
        for setting, values in differing(*records).items():
            for value, side in zip(values, differ.setdefault(setting, [{}, {}]), strict=True):
                side[str(value)] = value
    if differ is None:
        return None
    return {
        setting: [next(iter(side.values())) if len(side) == 1 else " | ".join(sorted(side)) for side in sides]
        for setting, sides in differ.items()
    }


def _contestants(
    cells: Mapping[Key, tuple[Row, ...]], labels: Mapping[Any, str], record: Mapping[str, Any]
) -> list[Report]:
    """For each contestant: completed flights, means of a and b over those that it completed in both, b against a."""
    metric = record.get("metric", "mean_error")
    confidence = record.get("confidence", 0.95)
    pooled: list[Statistic] = []
    records: list[Report] = []
    for contestant, label in labels.items():
        pairs = {key: pair for key, pair in cells.items() if key[1] == contestant}
        sides = []
        for (at, *_), pair in pairs.items():
            for side, row in zip("ab", pair, strict=True):
                sides.append((at, side, row))
        rows = [dict(row, controller=side, model="", variant=at.setting) for at, side, row in sides]
        comparison = overall(rows, metric=metric, baseline="a", confidence=confidence)
        if not comparison:  # its settings contradict each other
            continue
        pooled += comparison
        completed = []
        for p in pairs.values():
            if all(is_flown(row) and math.isfinite(row[metric]) for row in p):
                completed.append(p)
        means = (_mean([pair[i] for pair in completed], metric) for i in (0, 1))
        flown = {}
        for i, side in enumerate("ab"):
            flown[side] = [sum(is_flown(pair[i]) for pair in pairs.values()), len(pairs)]
        about = {"label": label, "cells": len(pairs), "flown": flown, "left_out": pooled[-1].left_out}
        records.append(about | change(*means))
    corrected = holm(np.array([s.p for s in pooled]))
    tests = int(np.count_nonzero(~np.isnan(corrected)))
    for line, s, p_holm in zip(records, pooled, corrected.tolist(), strict=True):
        s = replace(s, p_holm=p_holm, comparisons=tests)
        line["pairs"] = s.pairs
        line["seeds"] = s.units
        line["p"] = s.p
        line["p_holm"] = s.p_holm
        line["testable"] = s.testable
        line["ratio"] = -s.reduction
        line["ratio_low"] = -s.reduction_high
        line["ratio_high"] = -s.reduction_low
        line["distinguishable"] = s.significant
    return records


def _metric_lines(metrics: Sequence[Mapping[str, Any]], metric: str) -> list[str]:
    about = metric_of(metric)
    heading = [f"{about.title} ({about.unit})", "flown a", "flown b", "pairs", "seeds", "a", "b", "b - a", "ratio"]
    rows = []
    left_out = []
    for record in metrics:
        ratio = record["ratio"]
        low = record["ratio_low"]
        high = record["ratio_high"]
        text = relative(ratio) + ("" if ratio == 0 or math.isnan(low) else f" [{low:+.3g}, {high:+.3g}]")
        verdict = "not distinguishable" if record["testable"] else f"{count(record['seeds'], 'seed')} cannot tell"
        verdict = ("smaller" if ratio < 0 else "larger") if record["distinguishable"] else verdict
        verdict = {"-": "-", "same": "the same"}.get(text, verdict)
        flown = [f"{k} of {n}" for k, n in record["flown"].values()]
        numbers = [number(about.factor * record[name]) for name in ("a", "b", "difference")]
        p = p_value(record["p_holm"] if record["testable"] else math.nan)
        rows.append([record["label"], *flown, str(record["pairs"]), str(record["seeds"]), *numbers, text, p, verdict])
        if record["left_out"]:
            left_out.append(f"  {record['label']}: left out {re.sub(r' by a(?=,|$)', ' in a', record['left_out'])}")
    return Table([*heading, "p (Holm)", "b is"], rows, notes=left_out).lines()
