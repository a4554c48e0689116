"""What differs between two flights, two results or two checkpoints: in configuration, in outcome, in figures.

Everything is said as b against a: difference = b - a, relative = 100 (b - a) / a (%).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError, UsageError
from quadexp.learn.checkpoint import load_report
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, read_metadata
from quadexp.physics.state import POSITION
from quadexp.report.differences import change, differing, figure_lines, record_of, setting_lines
from quadexp.report.summary import MODEL_FILE, RESULTS_FILE, summarise

MEASURED = ("solve_time",)  # columns that two runs of one flight may differ in

# Figures of a flight, with the factor and unit they are shown in.
FIGURES = {
    "mean_error": (1e3, "mm"),
    "rmse": (1e3, "mm"),
    "max_error": (1e3, "mm"),
    "attitude_rmse": (180 / math.pi, "deg"),
    "saturated_share": (100.0, "%"),
    "peak_speed": (1.0, "m/s"),
    "duration": (1.0, "s"),
    "last_resort_count": (1.0, ""),
    "solve_time_median": (1e6, "us"),
    "solve_time_p99": (1e6, "us"),
}


def compare(a: str | Path, b: str | Path) -> dict[str, Any]:
    """What differs; `lines` is for people, the rest for programs (SI units).

    Raises UsageError where there is nothing, where a and b are of two kinds, or of one that cannot be compared.
    """
    kinds = [kind_of(Path(path)) for path in (a, b)]
    for path, kind in zip((a, b), kinds, strict=True):
        if kind not in ("flight", "results", "checkpoint"):
            raise UsageError(f"{path}: holds {kind}; flights, results and checkpoints can be compared")
    if kinds[0] != kinds[1]:
        raise UsageError(f"cannot compare {_a(kinds[0])} ({a}) with {_a(kinds[1])} ({b}): give two of one kind")
    if kinds[0] == "results":
        from quadexp.report.compare_results import compare_results

        return compare_results(Path(a), Path(b))
    return (compare_flights if kinds[0] == "flight" else compare_checkpoints)(Path(a), Path(b))


def _a(kind: str) -> str:
    return kind if kind == "results" else f"a {kind}"


def kind_of(path: Path) -> str:
    """ "flight", "results", "checkpoint", or whatever else the file says that it holds."""
    if not path.exists():
        raise UsageError(f"{path}: no such file or folder")
    if path.name == MODEL_FILE or (path / MODEL_FILE).is_file():
        return "checkpoint"
    if path.is_dir():
        if not (path / RESULTS_FILE).is_file():
            raise UsageError(f"{path}: neither a checkpoint ({MODEL_FILE}) nor results ({RESULTS_FILE}) in this folder")
        return "results"
    return read_metadata(path)["kind"]


def compare_flights(a: Path, b: Path) -> dict[str, Any]:
    """Two flights: settings, outcome, metrics, and how far apart the paths lie."""
    flights = [read_flight(path, check=False) for path in (a, b)]
    rows = [flight.metadata.get("row") or {} for flight in flights]
    for path, row in zip((a, b), rows, strict=True):
        if not row:
            raise UsageError(f"{path}: a flight without a result row (a recorded one?): it cannot be compared")
    settings = differing(*(record_of(flight.metadata) for flight in flights))
    outcome = [row["outcome"] for row in rows]
    causes = [flight.metadata.get("cause") or "" for flight in flights]
    metrics = {name: change(rows[0].get(name), rows[1].get(name)) for name in FIGURES}
    paths = _paths(*flights)
    heads = [
        f"{row['controller']} on {row['trajectory']}{_speed(row)}, {row['plant']}, seed {row['seed']}" for row in rows
    ]
    lines = [f"a  {a}: {heads[0]}", f"b  {b}: {heads[1]}", "", *setting_lines(settings), ""]
    said = [f"{word}{f' ({cause})' if cause else ''}" for word, cause in zip(outcome, causes, strict=True)]
    lines += [f"outcome  {said[0]}" if said[0] == said[1] else f"outcome  {said[0]} -> {said[1]}", ""]
    lines += [
        *figure_lines({f"{name} ({unit})" if unit else name: (metrics[name], f) for name, (f, unit) in FIGURES.items()})
    ]
    lines += ["", f"samples  {paths['text']}"]
    return {
        "kind": "flight",
        "a": str(a),
        "b": str(b),
        "configuration": settings,
        "outcome": outcome,
        "metrics": metrics,
        "paths": paths,
        "lines": lines,
    }


def _speed(row: Mapping[str, Any]) -> str:
    return "" if row["speed"] is None or math.isnan(row["speed"]) else f" at {row['speed']:g} m/s"


def _paths(a: Flight, b: Flight) -> dict[str, Any]:
    """How far apart two flights are at the same times, as far as they have the same times."""
    count = min(len(a), len(b))
    if count == 0 or not np.array_equal(a.t[:count], b.t[:count]):
        return {"common": 0, "identical": False, "text": "not at the same times: the paths are not compared"}
    names = [name for name in a.columns if name in b.columns and name not in MEASURED]
    same = len(a) == len(b) and set(a.columns) == set(b.columns)
    if same and all(np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f") for name in names):
        return {
            "common": count,
            "identical": True,
            "text": f"all {count} are the same to the last bit, solve times apart",
        }
    apart = np.linalg.norm(a.state[:count, POSITION] - b.state[:count, POSITION], axis=1)
    at = int(np.argmax(apart))
    length = "" if len(a) == len(b) else f" of {len(a)} and {len(b)}"
    text = f"at most {1e3 * apart[at]:.4g} mm apart, at t = {a.t[at]:.2f} s ({count} common samples{length})"
    return {"common": count, "identical": False, "distance": float(apart[at]), "t": float(a.t[at]), "text": text}


def compare_checkpoints(a: Path, b: Path) -> dict[str, Any]:
    """Two checkpoints: what they were fitted to and how, their parameters, and their held-out errors."""
    found = [summarise(path) for path in (a, b)]
    records = [
        {
            "kind": one["kind"],
            **{name: one[name] for name in ("vehicle", "dataset", "settings", "versions")},
            "outputs": {name: {"features": output["features"]} for name, output in one["outputs"].items()},
        }
        for one in found
    ]
    settings = differing(*records)
    left, right = (_parameters(path, one) for path, one in zip((a, b), found, strict=True))
    names = [name for name in left if name in right]
    metrics = {name: change(left[name], right[name]) for name in names}
    lines = [f"a  {a}: {found[0]['kind']}", f"b  {b}: {found[1]['kind']}", "", *setting_lines(settings), ""]
    lines += figure_lines({name: (metrics[name], 1.0) for name in names})
    only = {side: [n for n in mine if n not in its] for side, mine, its in (("a", left, right), ("b", right, left))}
    lines += [f"only in {side}: {', '.join(missing)}" for side, missing in only.items() if missing]
    return {
        "kind": "checkpoint",
        "a": str(a),
        "b": str(b),
        "configuration": settings,
        "metrics": metrics,
        "only": only,
        "lines": lines,
    }


def _parameters(path: Path, summary: Mapping[str, Any]) -> dict[str, float]:
    """The numbers of a checkpoint by name; held-out errors from the report beside it, where there is one."""
    folder = path.parent if path.name == MODEL_FILE else path
    values: dict[str, float] = {}
    units = {"a": "m/s^2", "t": "N m"}
    try:
        for row in load_report(folder).get("rows", []):
            if row.get("predictor") != "zero":
                name = f"held-out RMSE of {row['output']} by {row['predictor']} ({units[row['output'][0]]})"
                values[name] = float(row["rmse"])
    except (QuadexpError, ValueError, TypeError, KeyError, AttributeError):  # the model is whole without it
        values.clear()
    values |= {f"drag_{axis} (1/s)": value for axis, value in zip("xyz", summary["drag"], strict=True)}
    for output, one in summary["outputs"].items():
        values[f"{output} signal"], values[f"{output} noise"] = one["signal_std"], one["noise_std"]
        scales = zip(one["features"], one["lengthscale"], strict=True)
        values |= {f"{output} length of {feature}": scale for feature, scale in scales}
    return values
