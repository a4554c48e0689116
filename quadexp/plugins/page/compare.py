"""What differs between flights, results or checkpoints: in configuration, in outcome, in numbers.

Of two, b is compared with a: difference = b - a, relative = 100 (b - a) / a (%). Several are put side by side. How
results are compared stands in compare_results.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import UsageError
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.physics.state import norms
from quadexp.plugins.page.compare_results import compare_results
from quadexp.plugins.page.differences import (
    change,
    differing,
    names_of,
    record_of,
    setting_lines,
    setting_table,
    side_by_side,
)
from quadexp.plugins.page.typeset import relative
from quadexp.report.summary import held_out_rows, kind_of, summarise
from quadexp.report.table import Table
from quadexp.report.text import number, shown, speed_text

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
    row = flight.metadata.get("row")
    if not row:
        raise UsageError(f"{path}: a flight without a result row (a recorded one?): it cannot be compared")
    course = row["trajectory"]
    speed = speed_text(row["speed"])
    if speed:
        course = f"{course} at {speed}"
    about = f"{row['controller']} on {course}, {row['plant']}, seed {row['seed']}"
    numbers = {name: math.nan if row.get(name) is None else float(row[name]) for name in FIGURES}
    return Side(about, record_of(flight.metadata), numbers, flight)


def _checkpoint(path: Path) -> Side:
    """Its data, settings and features; its parameters, and the held-out errors of its report, if there is one."""
    summary = summarise(path)
    settings = {name: summary[name] for name in ("kind", "vehicle", "dataset", "settings", "versions")}
    numbers = {}
    for row in held_out_rows(path):
        if row["predictor"] != "zero":
            numbers[f"held-out RMSE of {row['output']} by {row['predictor']} ({row['unit']})"] = row["rmse"]
    for axis, drag in zip("xyz", summary["drag"], strict=True):
        numbers[f"drag_{axis} (1/s)"] = drag
    features = {}
    for name, output in summary["outputs"].items():
        features[name] = {"features": output["features"]}
        numbers[f"{name} signal"] = output["signal_std"]
        numbers[f"{name} noise"] = output["noise_std"]
        for feature, length in zip(output["features"], output["lengthscale"], strict=True):
            numbers[f"{name} length of {feature}"] = length
    return Side(summary["kind"], settings | {"outputs": features}, numbers)


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
            first, other = (k if k == "results" else f"a {k}" for k in (kinds[0], kind))
            raise UsageError(f"cannot compare {first} ({files[0]}) with {other} ({path}): give two of one kind")
    report: Report = {"kind": kinds[0], "names": names_of(paths)}
    if len(paths) == 2:
        report |= {"a": str(files[0]), "b": str(files[1])}
    if kinds[0] == "results":
        report |= compare_results(paths)
    else:
        report |= _compare_sides([SIDES[kinds[0]](path) for path in paths], paths)
    if len(paths) > 2:
        lines = []
        for table in report["tables"]:
            lines += ["", *table.lines()]
        report["lines"] = lines[1:]
    return report


def _compare_sides(sides: Sequence[Side], paths: Sequence[Path]) -> Report:
    """Settings and numbers beside each other; of two flights also the outcome and the distance between the paths."""
    settings = differing(*(side.settings for side in sides))
    numbers = side_by_side([side.numbers for side in sides], math.nan)
    names = names_of(paths)
    tables = [setting_table(settings, names)] if settings else []
    tables.append(Table(["figure", *names], [_number_row(name, values) for name, values in numbers.items()]))
    report: Report = {"configuration": settings, "metrics": numbers, "tables": tables}
    flights = [side.flight for side in sides if side.flight is not None]
    if flights:
        report["outcome"] = [flight.metadata["row"]["outcome"] for flight in flights]
    if len(sides) > 2:
        return report
    a, b = sides
    report["metrics"] = {name: change(*both) for name, both in numbers.items() if name in a.numbers.keys() & b.numbers}
    report["only"] = {
        "a": [name for name in a.numbers if name not in b.numbers],
        "b": [name for name in b.numbers if name not in a.numbers],
    }
    lines = [f"a  {paths[0]}: {a.about}", f"b  {paths[1]}: {b.about}", "", *setting_lines(settings), ""]
    if flights:
        lines += [f"outcome  {' -> '.join(dict.fromkeys(map(_ended, flights)))}", ""]
    rows = []
    for name, of_both in report["metrics"].items():
        numbers_of_both = [of_both["a"], of_both["b"], of_both["difference"]]
        rows.append([*_number_row(name, numbers_of_both), relative(of_both["relative"])])
    lines += Table(["", "a", "b", "b - a", "relative"], rows).lines()
    for side, missing in report["only"].items():
        if missing:
            lines.append(f"only in {side}: {', '.join(missing)}")
    if flights:
        report["paths"] = _paths(*flights)
        lines += ["", f"samples  {report['paths']['text']}"]
    return report | {"lines": lines}


def _number_row(name: str, values: Sequence[float]) -> list[str]:
    """Name and values of a number in its unit."""
    factor, unit = shown(name)
    return [f"{name} ({unit})" if unit else name, *(number(factor * value) for value in values)]


def _ended(flight: Flight) -> str:
    """The outcome of a flight, and its cause."""
    cause = flight.metadata.get("cause")
    return flight.metadata["row"]["outcome"] + (f" ({cause})" if cause else "")


def _paths(a: Flight, b: Flight) -> Report:
    """The distance between two flights at the times of the one with the longer period, as far as both flew."""
    if _identical(a, b):
        text = f"all {len(a)} are the same to the last bit, solve times apart"
        return {"common": len(a), "identical": True, "text": text}
    end = min(float(flight.t[-1]) if len(flight) else -math.inf for flight in (a, b))
    t = min((flight.t[flight.t <= end + 1e-9] for flight in (a, b)), key=len)
    if not len(t):
        return {"common": 0, "identical": False, "text": "one of them has none: the paths are not compared"}
    gaps = [np.interp(t, a.t, a[name]) - np.interp(t, b.t, b[name]) for name in ("p_x", "p_y", "p_z")]
    apart = norms(np.column_stack(gaps))
    at = int(np.argmax(apart))
    length = "" if len(a) == len(b) else f" of {len(a)} and {len(b)}"
    text = f"at most {1e3 * apart[at]:.4g} mm apart, at t = {t[at]:.2f} s ({len(t)} common samples{length})"
    return {"common": len(t), "identical": False, "distance": float(apart[at]), "t": float(t[at]), "text": text}


def _identical(a: Flight, b: Flight) -> bool:
    """Whether all samples are the same, measured columns apart."""
    if len(a) != len(b) or set(a.columns) != set(b.columns):
        return False
    names = [name for name in a.columns if name not in MEASURED]
    return all(np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f") for name in names)
