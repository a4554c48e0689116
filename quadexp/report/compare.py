"""What differs between flights: in configuration, in outcome, in numbers, in their paths.

Of two, b is compared with a: difference = b - a, relative = 100 (b - a) / a (%). Several are put side by side.
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
from quadexp.report.frame import flat
from quadexp.report.metrics import METRICS
from quadexp.report.summary import kind_of
from quadexp.report.table import Table
from quadexp.report.text import count, number, plain, relative, shown, speed_text

ABSENT = "-"
MOST_LINES = 16  # settings shown; --json has all
MOST_LETTERS = 36  # of a value
MOST_CONFIGURATIONS = 40  # cells whose configurations are read on either side
MEASURED = ("solve_time",)  # columns that two runs of one flight may differ in
FIGURES = (
    "mean_error", "rmse", "max_error", "attitude_rmse", "saturated_share", "peak_speed", "duration",
    "solve_time_median", "solve_time_p99",
)  # fmt: skip
EXACT = [name for name in METRICS if not name.startswith("solve_time")]  # the same for the same flight
NOTE = "means over the flights that all of them completed in every one of these results"

Key = tuple[Any, ...]  # condition, contestant, seed


class Side(NamedTuple):
    """A flight. about: it in a line. settings: what decides it. numbers: by name."""

    about: str
    settings: Mapping[str, Any]
    numbers: Mapping[str, float]
    flight: Flight


def _flight(path: Path) -> Side:
    flight = read_flight(path, check=False)
    row: Mapping[str, Any] = flight.metadata.get("row") or {}
    if not row:
        raise UsageError(f"{path}: a flight without a result row (a recorded one?): it cannot be compared")
    speed = f" at {text}" if (text := speed_text(row["speed"])) else ""
    about = f"{row['controller']} on {row['trajectory']}{speed}, {row['plant']}, seed {row['seed']}"
    numbers = {name: math.nan if row.get(name) is None else float(row[name]) for name in FIGURES}
    return Side(about, record_of(flight.metadata), numbers, flight)


OTHERS = {  # kind of file -> what to do instead
    "results": "fly both in one sweep, whose tables are paired, or join qx.load(A) and qx.load(B) in Python",
    "checkpoint": "`quadexp show` each, or `quadexp validate` both on flights",
}


def compare(*files: str | Path) -> dict[str, Any]:
    """What differs; `lines` and `tables` are for people, the rest for programs (SI units).

    Raises UsageError if something is not there, or no flight.
    """
    paths = [Path(path) for path in files]
    for path in paths:
        if (kind := kind_of(path)) != "flight":
            raise UsageError(f"{path}: holds {kind}; flights are compared: {OTHERS.get(kind, 'give flights')}")
    report: dict[str, Any] = {"kind": "flight", "names": names_of(paths)}
    report |= {"a": str(files[0]), "b": str(files[1])} if len(paths) == 2 else {}
    report |= _sides([_flight(path) for path in paths], paths)
    if len(paths) > 2:
        report["lines"] = [line for table in report["tables"] for line in ("", *table.lines())][1:]
    return report


def names_of(paths: Sequence[Path]) -> list[str]:
    """A short name of each path; the whole paths where two names would be the same."""
    short = [path.stem if path.is_file() else path.resolve().name for path in paths]
    return short if len(set(short)) == len(short) else list(map(str, paths))


# --------------------------------------------------------------------------------------------------- settings, numbers
def record_of(metadata: Mapping[str, Any]) -> dict[str, Any]:
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
    values = {key: [side.get(key, ABSENT) for side in sides] for side in sides for key in side}
    return {key: several for key, several in values.items() if any(value != several[0] for value in several)}


def change(a: float, b: float) -> dict[str, float]:
    """a, b, difference b - a, relative (%), NaN if not defined."""
    ratio = 100 * (b - a) / a if a else (0.0 if a == b else math.nan)
    return {"a": a, "b": b, "difference": b - a, "relative": ratio}


def _setting_table(settings: Mapping[str, Sequence[Any]], names: Sequence[str]) -> Table:
    """The settings that differ, a row each, at most MOST_LINES."""

    def short(value: Any) -> str:
        text = "null" if value is None else plain(value)
        return text if len(text) <= MOST_LETTERS else f"{text[: MOST_LETTERS - 3]}..."

    rows = [[key, *map(short, values)] for key, values in list(settings.items())[:MOST_LINES]]
    notes = [f"and {len(settings) - len(rows)} more (--json has all)"] if len(settings) > len(rows) else []
    return Table(["setting", *names], rows, left=frozenset(range(1 + len(names))), notes=notes)


def _setting_lines(settings: Mapping[str, Sequence[Any]]) -> list[str]:
    """The settings that differ between a and b, a line each."""
    if not settings:
        return ["configuration  the same"]
    text = count(len(settings), "setting") + (" differ" if len(settings) > 1 else " differs")
    return [f"configuration  {text}", *(f"  {line}" for line in _setting_table(settings, "ab").lines())]


def _number_row(name: str, values: Sequence[float]) -> list[str]:
    """Name and values of a number in its unit."""
    factor, unit = shown(name)
    return [f"{name} ({unit})" if unit else name, *(number(factor * value) for value in values)]


def _sides(sides: Sequence[Side], paths: Sequence[Path]) -> dict[str, Any]:
    """Settings and numbers beside each other; of two flights also the distance between their paths."""
    settings, names = differing(*(side.settings for side in sides)), names_of(paths)
    metrics = {name: [side.numbers[name] for side in sides] for name in FIGURES}
    tables = [_setting_table(settings, names)] if settings else []
    tables.append(Table(["figure", *names], [_number_row(name, values) for name, values in metrics.items()]))
    outcomes = [side.flight.metadata["row"]["outcome"] for side in sides]
    report: dict[str, Any] = {"configuration": settings, "metrics": metrics, "tables": tables, "outcome": outcomes}
    if len(sides) > 2:
        return report
    a, b = sides
    changes = {name: change(*values) for name, values in metrics.items()}
    rows = [
        [*_number_row(name, [values["a"], values["b"], values["difference"]]), relative(values["relative"])]
        for name, values in changes.items()
    ]
    causes = [f" ({cause})" if (cause := side.flight.metadata.get("cause")) else "" for side in sides]
    ended = dict.fromkeys(map("".join, zip(outcomes, causes, strict=True)))
    between = _paths(a.flight, b.flight)
    lines = [f"a  {paths[0]}: {a.about}", f"b  {paths[1]}: {b.about}", "", *_setting_lines(settings), ""]
    lines += [f"outcome  {' -> '.join(ended)}", ""]
    lines += [*Table(["", "a", "b", "b - a", "relative"], rows).lines(), "", f"samples  {between['text']}"]
    return report | {"metrics": changes, "paths": between, "lines": lines}


def _paths(a: Flight, b: Flight) -> dict[str, Any]:
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
    paths = [np.column_stack([np.interp(t, flight.t, flight[f"p_{i}"]) for i in "xyz"]) for flight in (a, b)]
    apart = np.linalg.norm(paths[0] - paths[1], axis=1)
    at = int(np.argmax(apart))
    length = "" if len(a) == len(b) else f" of {len(a)} and {len(b)}"
    text = f"at most {1e3 * apart[at]:.4g} mm apart, at t = {t[at]:.2f} s ({len(t)} common samples{length})"
    return {"common": len(t), "identical": False, "distance": float(apart[at]), "t": float(t[at]), "text": text}
