"""Whether a folder of results holds what was written there: every flight, every table, every figure of a row."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from quadexp.errors import QuadexpError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_table
from quadexp.provenance import content_hash
from quadexp.report.checked import COMPARED
from quadexp.report.frame import RESULTS
from quadexp.report.tables import STATISTICS
from quadexp.sweeps.sweep_table import Row, altered_texts, open_results, read_rows, table_row

TEXTS = ("results.csv", "statistics.csv", "table.md", "table.tex", "comparison.tex")


@dataclass
class Verified:
    """files: how many were looked at. wrong: file -> what is wrong with it. missing: those that decided its flights
    and are not there, as on another machine: they are not compared."""

    files: int = 0
    missing: list[str] = field(default_factory=list)
    wrong: dict[str, str] = field(default_factory=dict)

    def look(self, path: Path, read: Callable[[], Any]) -> Any:
        """Count a file and read it; None where it is damaged."""
        self.files += 1
        try:
            return read()
        except QuadexpError as error:
            text = str(error).removeprefix(f"{path}: ")
            self.wrong[str(path)] = text.partition(";")[0].partition(": make it again")[0]
            return None


def verify_results(out: str | Path, progress: Callable[[int, int], None] = lambda done, total: None) -> Verified:
    """Read everything in a folder of results and compare it with its hashes, rows with their flights, and tables and
    texts with the rows they are made of.

    Raises UsageError for a folder without results.
    """
    store = open_results(out)
    verified = Verified()
    keys = sorted(store.done())
    path = store.root / RESULTS
    flights: dict[str, Row | None] = {}
    for count, key in enumerate(keys, 1):
        flights[key] = verified.look(store.path(key), functools.partial(_flight_row, store, key))
        progress(count, len(keys))
    if path.exists():
        if (table := verified.look(path, lambda: read_rows(path))) is not None:
            rows, record = table
            if wrong := _unlike(rows, flights) or _edited(record):
                verified.wrong[str(path)] = wrong
            verified.missing = [file for file in record.get("files", {}) if not Path(file).is_file()]
            _verify_made(store.root, record, verified)
    elif any((store.root / name).exists() for name in (*TEXTS, STATISTICS)):
        verified.wrong[str(path)] = "is not there, and what is made of it is"
    return verified


def _flight_row(store: CellStore, key: str) -> Row:
    row = store.row(key)
    read_table(store.path(key), "flight")
    return table_row({**row, "key": key})


def _unlike(rows: list[Row], flights: dict[str, Row | None]) -> str:
    """How a table differs from what the flights say, in one line, "" where it does not. flights: None if damaged."""
    other = []
    lost = []
    for row in rows:
        flight = flights.get(row["key"])
        if flight is not None:
            other += [f"{row['key']} ({name})" for name in COMPARED if not _same(flight[name], row[name])][:1]
        elif row["key"] not in flights and row["outcome"] not in ("failed", "invalid"):
            lost.append(row["key"])
    differences = {"are not what their flights say": other, "are of flights that are not there": lost}
    return "; ".join(f"{len(keys)} rows {what}, the first {keys[0]}" for what, keys in differences.items() if keys)


def _edited(record: dict[str, Any]) -> str:
    """Which files that decided its flights have another content now, in one line, "" for none. What is not there any
    more, as on another machine, is not compared. Nothing of it is executed."""
    files = record.get("files", {})
    other = []
    for path, content in files.items():
        if Path(path).is_file() and content_hash(path) != content:
            other.append(path)
    return f"is of flights with another content of {', '.join(other)}: run the sweep again" if other else ""


def _same(a: Any, b: Any) -> bool:
    return bool(a == b or (a != a and b != b))  # NaN equals NaN here


def _verify_made(root: Path, record: dict[str, Any], verified: Verified) -> None:
    """Look at what was made of the rows."""
    stated = record.get("made", {})
    path = root / STATISTICS
    verified.files += sum((root / name).is_file() for name in stated)
    verified.wrong |= altered_texts(root, record)
    wanted = [*stated, STATISTICS] if "statistics" in record else [*stated]
    verified.wrong |= {str(root / name): "is not there" for name in wanted if not (root / name).is_file()}
    statistics = verified.look(path, lambda: read_table(path, "statistics")) if path.exists() else None
    if statistics and record.get("statistics", statistics[1].get("fingerprint")) != statistics[1].get("fingerprint"):
        verified.wrong[str(path)] = f"is not of the rows of {RESULTS}"
