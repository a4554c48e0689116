"""What differs between flights, results or checkpoints: in configuration, in outcome, in figures.

Every other one is compared with the first, b with a: difference = b - a, relative = 100 (b - a) / a (%). Several are
also put side by side, a column each. Results have a way of their own: compare_results.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import UsageError
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, read_metadata
from quadexp.report.compare_results import (
    change,
    compare_results,
    differing,
    record_of,
    results_beside,
    setting_lines,
    setting_table,
)  # fmt: skip
from quadexp.report.frame import flat
from quadexp.report.held_out import held_out_rows
from quadexp.report.summary import MODEL_FILE, RESULTS_FILE, summarise
from quadexp.report.table import Table
from quadexp.report.text import number, relative, shown, speed_text

MOST_ACROSS = 6  # columns of several side by side; with more paths each is a row
MOST_DETAILED = 4  # others that are compared with the first one by one, in the lines
MEASURED = ("solve_time",)  # columns that two runs of one flight may differ in
FIGURES = (
    "mean_error", "rmse", "max_error", "attitude_rmse", "saturated_share", "peak_speed", "duration",
    "solve_time_median", "solve_time_p99",
)  # fmt: skip


class Side(NamedTuple):
    """A flight or a checkpoint. about: it in a line. settings: what decides it. numbers: its figures by name. flight:
    None of a checkpoint."""

    about: str
    settings: Mapping[str, Any]
    numbers: Mapping[str, float]
    flight: Flight | None = None


def _flight(path: Path) -> Side:
    flight = read_flight(path, check=False)
    row: Mapping[str, Any] = flight.metadata.get("row") or {}
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
    folder = path.parent if path.name == MODEL_FILE else path
    numbers = {
        f"held-out RMSE of {row['output']} by {row['predictor']} ({row['unit']})": row["rmse"]
        for row in held_out_rows(folder)
        if row["predictor"] != "zero"
    }
    numbers |= {f"drag_{axis} (1/s)": value for axis, value in zip("xyz", summary["drag"], strict=True)}
    for output, one in summary["outputs"].items():
        numbers[f"{output} signal"], numbers[f"{output} noise"] = one["signal_std"], one["noise_std"]
        scales = zip(one["features"], one["lengthscale"], strict=True)
        numbers |= {f"{output} length of {feature}": scale for feature, scale in scales}
    return Side(summary["kind"], {**{name: summary[name] for name in names}, "outputs": features}, numbers)


SIDES = {"flight": _flight, "checkpoint": _checkpoint}


def compare(first: str | Path, *others: str | Path) -> dict[str, Any]:
    """What differs; `lines` is for people, the rest for programs (SI units).

    With several others: {"kind", "together": all side by side, "comparisons": one per other, "lines"}.
    Raises UsageError if something is not there, not of the same kind, or of a kind that cannot be compared.
    """
    paths = [Path(path) for path in (first, *others)]
    kinds = [kind_of(path) for path in paths]
    for path, kind in zip(paths, kinds, strict=True):
        if kind not in ("results", *SIDES):
            raise UsageError(f"{path}: holds {kind}; flights, results and checkpoints can be compared")
        if kind != kinds[0]:
            named = [k if k == "results" else f"a {k}" for k in (kinds[0], kind)]
            raise UsageError(f"cannot compare {named[0]} ({first}) with {named[1]} ({path}): give two of one kind")
    comparisons: list[dict[str, Any]] = []
    for other in paths[1:]:
        two = compare_results(paths[0], other) if kinds[0] == "results" else _two(kinds[0], paths[0], other)
        comparisons.append({"kind": kinds[0], "a": str(first), "b": str(other), **two})
    if len(comparisons) == 1:
        return comparisons[0]
    together = beside(kinds[0], paths)
    texts = [table.lines() for table in together.pop("tables")]
    each = [comparison.pop("lines") for comparison in comparisons]
    lines = [line for text in texts + each * (len(each) <= MOST_DETAILED) for line in ("", *text)][1:]
    return {"kind": kinds[0], "together": together, "comparisons": comparisons, "lines": lines}


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


def names_of(paths: Sequence[Path]) -> list[str]:
    """A short name of each path; the whole paths where two names would be the same."""
    short = [path.stem if path.is_file() else path.resolve().name for path in paths]
    return short if len(set(short)) == len(short) else list(map(str, paths))


def beside(kind: str, paths: Sequence[Path]) -> dict[str, Any]:
    """`names`, `configuration` and `metrics` (name -> a value for each path), and `tables` of both."""
    names = names_of(paths)
    if kind == "results":
        return results_beside(paths, names)
    sides = [SIDES[kind](path) for path in paths]
    outcomes = [{"outcome": side.flight.metadata["row"]["outcome"]} if side.flight else {} for side in sides]
    settings = differing(*(flat(side.settings) | outcome for side, outcome in zip(sides, outcomes, strict=True)))
    metrics = {name: [side.numbers.get(name, math.nan) for side in sides] for side in sides for name in side.numbers}
    rows = [_printed(name, values) for name, values in metrics.items()]
    tables = [setting_table(settings, names)] if settings else []
    tables = [*map(_narrow, [*tables, Table(["figure", *names], rows)])]
    return {"names": names, "configuration": settings, "metrics": metrics, "tables": tables}


def _printed(name: str, values: Sequence[float]) -> list[str]:
    """Name and values of a figure in its unit."""
    factor, unit = shown(name)
    return [f"{name} ({unit})" if unit else name, *(number(factor * value) for value in values)]


def _narrow(table: Table) -> Table:
    """The table turned, a row a path, where there are many paths."""
    if len(table.columns) <= 1 + MOST_ACROSS:
        return table
    heads = ["", *(row[0] for row in table.rows)]
    rows = list(zip(*[table.columns[1:], *(row[1:] for row in table.rows)], strict=True))
    left = frozenset({0}) if table.columns[0] == "figure" else frozenset(range(len(heads)))
    return Table(heads, rows, left=left, notes=table.notes)


def _two(kind: str, first: Path, other: Path) -> dict[str, Any]:
    """b with a: settings, figures, and of flights the outcome and the distance between the paths."""
    a, b = SIDES[kind](first), SIDES[kind](other)
    settings = differing(a.settings, b.settings)
    metrics = {name: change(a.numbers[name], b.numbers[name]) for name in a.numbers if name in b.numbers}
    lines = [f"a  {first}: {a.about}", f"b  {other}: {b.about}", "", *setting_lines(settings), ""]
    rows = [
        [*_printed(name, [one["a"], one["b"], one["difference"]]), relative(one["relative"])]
        for name, one in metrics.items()
    ]
    figures = Table(["", "a", "b", "b - a", "relative"], rows).lines()
    made = {"configuration": settings, "metrics": metrics}
    if a.flight is None or b.flight is None:
        only = {"a": [n for n in a.numbers if n not in b.numbers], "b": [n for n in b.numbers if n not in a.numbers]}
        missing = [f"only in {side}: {', '.join(names)}" for side, names in only.items() if names]
        return {**made, "only": only, "lines": [*lines, *figures, *missing]}
    records = [flight.metadata for flight in (a.flight, b.flight)]
    outcome = [record["row"]["outcome"] for record in records]
    causes = [f" ({record['cause']})" if record.get("cause") else "" for record in records]
    ended = dict.fromkeys(map("".join, zip(outcome, causes, strict=True)))
    paths = _paths(a.flight, b.flight)
    lines += [f"outcome  {' -> '.join(ended)}", "", *figures, "", f"samples  {paths['text']}"]
    return {**made, "outcome": outcome, "paths": paths, "lines": lines}


def _paths(a: Flight, b: Flight) -> dict[str, Any]:
    """The distance between two flights at the times of the one with the longer period, as far as both flew."""
    names = [name for name in a.columns if name in b.columns and name not in MEASURED]
    same = len(a) == len(b) and set(a.columns) == set(b.columns)
    if same and all(np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f") for name in names):
        text = f"all {len(a)} are the same to the last bit, solve times apart"
        return {"common": len(a), "identical": True, "text": text}
    times = [flight.t for flight in (a, b)]
    end = min((float(t[-1]) for t in times if len(t)), default=0.0) if all(map(len, times)) else -math.inf
    t = min((t[t <= end + 1e-9] for t in times), key=len)
    if not len(t):
        return {"common": 0, "identical": False, "text": "one of them has none: the paths are not compared"}
    paths = [np.column_stack([np.interp(t, f.t, f[f"p_{i}"]) for i in "xyz"]) for f in (a, b)]
    apart = np.linalg.norm(paths[0] - paths[1], axis=1)
    at = int(np.argmax(apart))
    length = "" if len(a) == len(b) else f" of {len(a)} and {len(b)}"
    text = f"at most {1e3 * apart[at]:.4g} mm apart, at t = {t[at]:.2f} s ({len(t)} common samples{length})"
    return {"common": len(t), "identical": False, "distance": float(apart[at]), "t": float(t[at]), "text": text}
