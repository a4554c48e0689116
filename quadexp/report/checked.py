"""What the rows of a table are worth: which programs flew them, and whether their files are there and say the same.

Commands that show results look at so many files, evenly chosen.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from quadexp.errors import QuadexpError
from quadexp.log.cell_store import CellStore
from quadexp.names import named
from quadexp.report.metrics import ROW_COLUMNS, errors_none
from quadexp.report.text import count

MOST = 500  # files that are looked at
COMPARED = [name for name in ROW_COLUMNS if name != "variant"]  # which the sweep gives, not the flight
UNKNOWN = "an earlier version that did not say"  # of a row without sources

Row = Mapping[str, Any]


class Checked(NamedTuple):
    """looked: at so many of the `flights` that a table has. Keys of those that are not there, that cannot be read or
    have changed since they were written, and that say something else than the table. beside: number of files that the
    table does not have."""

    looked: int
    flights: int
    missing: list[str]
    unreadable: list[str]
    other: list[str]
    beside: int

    def lines(self, *, beside: bool = True) -> list[str]:
        """What is wrong, a line each. beside: also that there are files which the table does not have."""
        if self.looked and len(self.missing) == self.looked:
            return ["none of the flights of this table is in its folder: what it says could not be checked"]
        faults = {
            "cannot be read, or were edited since they were written": self.unreadable,
            "say something else than the table, which may be of another sweep": self.other,
            "are not in this folder: the table may be of another sweep": self.missing,
        }
        of = f"of {self.looked} files of flights that were checked"
        lines = [f"{len(keys)} {of} {fault} (the first: {keys[0]})" for fault, keys in faults.items() if keys]
        if beside and self.beside:
            lines.append(f"{count(self.beside, 'file')} of flights in this folder belong to another sweep: not shown")
        return lines

    def text(self) -> str:
        """How much was checked, in a sentence."""
        bad = len(self.missing) + len(self.unreadable) + len(self.other)
        what = "all" if not bad else str(self.looked - bad)
        return f"{self.looked} of {count(self.flights, 'file')} of flights checked: {what} hold what the table says"


def check_flights(
    root: str | Path, rows: Sequence[Row], table: Sequence[Row] | None = None, most: int = MOST
) -> Checked:
    """Compare rows of results with the files of their flights in the folder `root`. table: all rows that the table has,
    where these are some of them."""
    store = CellStore(root)
    flown = [row for row in rows if row["outcome"] not in ("failed", "invalid", "damaged")]
    chosen = flown[:: max(1, -(-len(flown) // most))]
    there = store.done()
    missing = []
    unreadable = []
    other = []
    for row in chosen:
        key = str(row["key"])
        if key not in there:
            missing.append(key)
            continue
        try:
            stored = store.row(key)
        except QuadexpError:
            unreadable.append(key)
            continue
        stored |= errors_none(stored.get("outcome")) | {"key": key}
        if any(_plain(stored.get(name)) != _plain(row.get(name)) for name in COMPARED):
            other.append(key)
    beside = len(there - {str(row["key"]) for row in (rows if table is None else table)})
    return Checked(len(chosen), len(flown), missing, unreadable, other, beside)


def _plain(value: Any) -> Any:
    """One value for what is missing: a table has NaN, zero or an empty text for it."""
    return None if value is None or value != value or not value else value


def flown_by(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """The programs that flew the rows, the most frequent first: program, sources, libraries, cells."""
    names = ("program", "sources", "libraries")
    counts = Counter(tuple(row.get(name) or "" for name in names) for row in rows)
    return [{**named(names, program), "cells": cells} for program, cells in counts.most_common()]


def program_name(row: Row) -> str:
    """The program of a row, for people."""
    return f"quadexp {row.get('program')}, sources {row['sources']}" if row.get("sources") else UNKNOWN


def programs_text(rows: Iterable[Row]) -> str:
    """Such as "3 by quadexp 0.1.0, sources 78f30eeaa2be; 2 by ...", the most frequent first."""
    return "; ".join(f"{cells} by {name}" for name, cells in Counter(map(program_name, rows)).most_common())


def flown_by_lines(rows: Iterable[Row]) -> list[str]:
    """The lines of `show` on the programs of a table of results."""
    lines = []
    for program in flown_by(rows):
        lines.append(f"flown by    {program_name(program)}: {program['cells']} cells")
        lines += [f"            {program['libraries']}"] if program["libraries"] else []
    return lines


def differing_libraries(texts: Iterable[str | None], here: str) -> str:
    """One line on the cells flown with other versions of libraries than those in `here`; "" if there are none.

    texts: `libraries` of each row.
    """
    counts: Counter[str] = Counter()
    cells = 0
    now = _versions(here)
    for text, rows in Counter(texts).items():
        other = _versions(text or "").items() - now.items()
        cells += rows if other else 0
        counts.update({f"{name} {version} (here {now.get(name, 'none')})": rows for name, version in sorted(other)})
    parts = ", ".join(f"{rows} with {what}" for what, rows in counts.most_common())
    return f"{cells} cells were flown with other libraries: {parts}" if cells else ""


def versions_of(rows: Iterable[Row]) -> dict[str, str]:
    """Name -> version of the program, its sources and every library in the rows; several are joined by " | "."""
    versions: dict[str, dict[str, None]] = {}
    for program in flown_by(rows):
        parts = {"quadexp": program["program"], "sources": program["sources"], **_versions(program["libraries"])}
        for name, version in parts.items():
            versions.setdefault(name, {})[version or "unknown"] = None
    return {name: " | ".join(values) for name, values in versions.items()}


def _versions(text: str) -> dict[str, str]:
    """Name -> version from the text of a row's libraries."""
    return {name: version for part in text.split(", ") for name, _, version in [part.partition(" ")] if version}
