"""What two or more flights, results or checkpoints differ in: settings, and a number beside another one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.parts.settings import flat
from quadexp.report.table import Table
from quadexp.report.text import count, plain

ABSENT = "-"
MOST_LINES = 16  # settings shown; --json has all
MOST_LETTERS = 36  # of a value

Settings = dict[str, list[Any]]  # dotted key -> its value on every side


def names_of(paths: Sequence[Path]) -> list[str]:
    """A short name of each path; the whole paths where two names would be the same."""
    short = [path.stem if path.is_file() else path.resolve().name for path in paths]
    if len(set(short)) == len(short):
        return short
    return list(map(str, paths))


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


def side_by_side(records: Sequence[Mapping[str, Any]], missing: Any) -> dict[str, list[Any]]:
    """Key -> its value in each record."""
    values = {}
    for record in records:
        for key in record:
            values[key] = [other.get(key, missing) for other in records]
    return values


def differing(*records: Mapping[str, Any]) -> Settings:
    """Dotted key -> its value in each, for those that differ; "-" for a missing key."""
    settings = side_by_side([*map(flat, records)], ABSENT)
    different = {}
    for key, values in settings.items():
        if any(value != values[0] for value in values):
            different[key] = values
    return different


def change(a: float, b: float) -> dict[str, float]:
    """a, b, difference b - a, relative (%), NaN if not defined."""
    relative = 0.0 if a == b else math.nan
    if a:
        relative = 100 * (b - a) / a
    return {"a": a, "b": b, "difference": b - a, "relative": relative}


def setting_table(settings: Settings, names: Sequence[str]) -> Table:
    """The settings that differ, a row each, at most MOST_LINES."""
    rows = []
    for key, values in settings.items():
        rows.append([key, *map(_short, values)])
    hidden = len(rows) - MOST_LINES
    notes = [f"and {hidden} more (--json has all)"] if hidden > 0 else []
    return Table(["setting", *names], rows[:MOST_LINES], left=frozenset(range(1 + len(names))), notes=notes)


def _short(value: Any) -> str:
    text = "null" if value is None else plain(value)
    if len(text) <= MOST_LETTERS:
        return text
    return f"{text[: MOST_LETTERS - 3]}..."


def setting_lines(settings: Settings | None) -> list[str]:
    """The settings that differ between a and b, a line each; None where they are not known."""
    if settings is None:
        return ["configuration  not compared: the cells are not beside both tables"]
    if not settings:
        return ["configuration  the same"]
    verb = "differ" if len(settings) > 1 else "differs"
    lines = [f"configuration  {count(len(settings), 'setting')} {verb}"]
    return lines + [f"  {line}" for line in setting_table(settings, "ab").lines()]
