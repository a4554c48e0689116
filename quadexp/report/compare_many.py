"""Several flights, results or checkpoints side by side: a column each, a row a setting that differs or a figure.

The numbers of results are means over the flights that every contestant ended well in all of them (pairing.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.log.store import read_flight, read_table
from quadexp.report.compare_parts import FIGURES, checkpoint_record, flat, matched, parameters, record_of
from quadexp.report.metrics import SHOWN
from quadexp.report.pairing import common, contestant_labels
from quadexp.report.result_rows import from_columns
from quadexp.report.summary import RESULTS_FILE, summarise
from quadexp.report.table import Table
from quadexp.report.tables import TITLES
from quadexp.report.text import number

ABSENT = "-"
MOST_ACROSS = 6  # columns; with more paths each is a row
MOST_LINES = 16  # settings shown; --json has all

Side = tuple[dict[str, Any], dict[str, float]]  # settings by dotted key, figures by name


def names_of(paths: Sequence[Path]) -> list[str]:
    """A short name of each path; the whole paths where two names would be the same."""
    short = [path.stem if path.is_file() else path.resolve().name for path in paths]
    return short if len(set(short)) == len(short) else list(map(str, paths))


def beside(kind: str, paths: Sequence[Path]) -> dict[str, Any]:
    """`names`, `configuration` and `metrics` (name -> a value for each path), and `tables` of both."""
    names = names_of(paths)
    if kind == "results":
        metric, rows = results_means(paths)
        factor, unit = SHOWN[metric]
        heads = [f"{TITLES[metric]} ({unit})", *names, "flights"]
        lines = [
            [label, *(number(factor * v) for v in means), str(flights)] for label, (means, flights) in rows.items()
        ]
        table = Table(heads, lines, notes=[NOTE])
        return {"names": names, "metrics": {label: means for label, (means, _) in rows.items()}, "tables": [table]}
    sides = [SIDES[kind](path) for path in paths]
    keys = dict.fromkeys(key for settings, _ in sides for key in settings)
    values = {key: [settings.get(key, ABSENT) for settings, _ in sides] for key in keys}
    differing = {key: found for key, found in values.items() if any(value != found[0] for value in found)}
    figures = dict.fromkeys(name for _, numbers in sides for name in numbers)
    metrics = {name: [numbers.get(name, math.nan) for _, numbers in sides] for name in figures}
    rest = len(differing) - MOST_LINES
    shown = [[key, *map(_short, found)] for key, found in list(differing.items())[:MOST_LINES]]
    notes = [f"and {rest} more (--json has all)"] if rest > 0 else []
    tables = [Table(["setting", *names], shown, left=frozenset(range(1 + len(names))), notes=notes)] if shown else []
    factors = FIGURES if kind == "flight" else {}
    lines = [
        [
            f"{name} ({factors[name][1]})" if name in factors else name,
            *(number(factors.get(name, (1,))[0] * v) for v in found),
        ]
        for name, found in metrics.items()
    ]
    tables.append(Table(["figure", *names], lines))
    return {"names": names, "configuration": differing, "metrics": metrics, "tables": [*map(_narrow, tables)]}


NOTE = "means over the flights that all of them ended well in every one of these results"


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


def _narrow(table: Table) -> Table:
    """The table turned, a row a path, where there are many paths."""
    if len(table.columns) <= 1 + MOST_ACROSS:
        return table
    heads = ["", *(row[0] for row in table.rows)]
    rows = list(zip(*[table.columns[1:], *(row[1:] for row in table.rows)], strict=True))
    return Table(
        heads,
        rows,
        left=frozenset({0}) if table.columns[0] == "figure" else frozenset(range(len(heads))),
        notes=table.notes,
    )


def _flight_side(path: Path) -> Side:
    record = read_flight(path, check=False).metadata
    row: Mapping[str, Any] = record.get("row") or {}
    numbers = {name: math.nan if row.get(name) is None else float(row[name]) for name in FIGURES}
    return flat(record_of(record)) | {"outcome": row.get("outcome", ABSENT)}, numbers


def _checkpoint_side(path: Path) -> Side:
    summary = summarise(path)
    return flat(checkpoint_record(summary)), parameters(path, summary)


SIDES = {"flight": _flight_side, "checkpoint": _checkpoint_side}


def _short(value: Any) -> str:
    text = "null" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 28 else text[:25] + "..."
