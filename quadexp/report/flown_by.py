"""The programs that flew the rows of a table: versions, sources and libraries as recorded in the cells."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

UNKNOWN = "an earlier version that did not say"


def flown_by(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The programs that flew the rows, the most frequent first: program, sources, libraries, cells."""
    counts = Counter(tuple(row.get(name) or "" for name in ("program", "sources", "libraries")) for row in rows)
    return [
        {"program": program, "sources": sources, "libraries": libraries, "cells": count}
        for (program, sources, libraries), count in counts.most_common()
    ]


def program_name(row: Mapping[str, Any]) -> str:
    """The program of a row, for people."""
    if not row.get("sources"):
        return UNKNOWN
    return f"quadexp {row.get('program')}, sources {row['sources']}"


def programs_text(rows: Iterable[Mapping[str, Any]]) -> str:
    """Such as "3 by quadexp 0.1.0, sources 78f30eeaa2be; 2 by ...", the most frequent first."""
    return "; ".join(f"{count} by {name}" for name, count in Counter(map(program_name, rows)).most_common())


def mixed_programs(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The line below a table with flights of several programs; else empty."""
    programs = len(set(map(program_name, rows)))
    return [f"flights of {programs} programs stand side by side: {programs_text(rows)}"] if programs > 1 else []


def differing_libraries(texts: Iterable[str | None], here: str) -> str:
    """One line on the cells flown with other versions of libraries than those in `here`; "" if there are none.

    texts: `libraries` of each row.
    """
    counts: Counter[str] = Counter()
    cells = 0
    now = _versions(here)
    for text, count in Counter(texts).items():
        other = {name: there for name, there in _versions(text or "").items() if now.get(name) != there}
        cells += count if other else 0
        for name, there in other.items():
            counts[f"{name} {there} (here {now.get(name, 'none')})"] += count
    if not cells:
        return ""
    return f"{cells} cells were flown with other libraries: " + ", ".join(
        f"{count} with {what}" for what, count in counts.most_common()
    )


def versions_of(rows: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """Name -> version of the program, its sources and every library in the rows; several are joined by " | "."""
    found: dict[str, dict[str, None]] = {}
    for one in flown_by(rows):
        parts = {"quadexp": one["program"], "sources": one["sources"], **_versions(one["libraries"])}
        for name, version in parts.items():
            found.setdefault(name, {})[version or "unknown"] = None
    return {name: " | ".join(values) for name, values in found.items()}


def flown_by_lines(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """The lines of `show` on the programs of a table of results."""
    lines = []
    for one in flown_by(rows):
        lines.append(f"flown by    {program_name(one)}: {one['cells']} cells")
        if one["libraries"]:
            lines.append(f"            {one['libraries']}")
    return lines


def _versions(text: str) -> dict[str, str]:
    """Name -> version from the text of a row's libraries."""
    return {name: version for part in text.split(", ") for name, _, version in [part.partition(" ")] if version}
