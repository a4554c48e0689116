"""What comparisons are made of: settings as dotted keys, those that differ, changes, and their lines."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from quadexp.report.table import Table
from quadexp.report.text import count, number, relative

ABSENT = "-"
MOST_LINES = 16  # settings shown; --json has all
MOST_LETTERS = 36  # of a value


def flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Nested mappings as dotted keys."""
    if not isinstance(value, Mapping):
        return {prefix[:-1]: value}
    return {key: item for name, inner in value.items() for key, item in flat(inner, f"{prefix}{name}.").items()}


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


def figure_lines(figures: Iterable[tuple[str, Mapping[str, float], float]]) -> list[str]:
    """A table of changes. figures: name, change, and the factor it is printed with."""
    rows = [
        [name, *(number(factor * one[key]) for key in ("a", "b", "difference")), relative(one["relative"])]
        for name, one, factor in figures
    ]
    return Table(["", "a", "b", "b - a", "relative"], rows).lines()
