"""Whether a folder of results holds what was written there: every flight, every table, every figure of a row.

Files of before there were hashes cannot be verified; that is said and is no fault.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from quadexp.errors import QuadexpError, UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import has_content_hash, read_table
from quadexp.report.statistics_file import FILE
from quadexp.report.tables import ROW_COLUMNS, to_columns
from quadexp.sweep.rows import Rows
from quadexp.sweep.sweep_table import RESULTS, UNFINISHED, altered_texts

TEXTS = ("results.csv", "statistics.csv", "table.md", "table.tex", "comparison.tex")

Row = dict[str, Any]


@dataclass
class Verified:
    """files: how many were looked at. wrong: file -> what is wrong with it. unhashed: files without hashes, which can
    only be read."""

    files: int = 0
    wrong: dict[str, str] = field(default_factory=dict)
    unhashed: list[str] = field(default_factory=list)


def verify_results(out: str | Path, progress: Callable[[int, int], None] = lambda done, total: None) -> Verified:
    """Read everything in a folder of results and compare it with its hashes, rows with their flights, and tables and
    texts with the rows they are made of.

    Raises UsageError for a folder without results.
    """
    store = CellStore(out)
    if not store.folder.is_dir() and not (store.root / RESULTS).exists():
        raise UsageError(f"{out}: holds no results (made by `quadexp evaluate`)")
    found = Verified()
    keys = sorted(store.done())
    rows: dict[str, Row] = {}
    for count, key in enumerate(keys, 1):
        row = _cell(store, key, found)
        if row is not None:
            rows[key] = row
        progress(count, len(keys))
    there = set(keys)
    for path in (store.root / RESULTS, store.folder / UNFINISHED):
        table = _table(path, "results", found)
        if table is None:
            continue
        columns, record = table
        listed = Rows.of(columns)
        found.wrong |= {str(path): wrong for wrong in _unlike(listed, rows, there)}
        if path.name == RESULTS:
            _made(store.root, record, found)
    return found


def _cell(store: CellStore, key: str, found: Verified) -> Row | None:
    path = store.path(key)
    found.files += 1
    try:
        row = store.row(key)
        read_table(path, "flight")
        if not has_content_hash(path):
            found.unhashed.append(str(path))
    except QuadexpError as error:
        found.wrong[str(path)] = _said(error, path)
        return None
    return row


def _table(path: Path, kind: str, found: Verified) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """A table as it was written, or None."""
    if not path.exists():
        return None
    found.files += 1
    try:
        table = read_table(path, kind, required=("key", "outcome") if kind == "results" else ())
    except QuadexpError as error:
        found.wrong[str(path)] = _said(error, path)
        return None
    if not has_content_hash(path):
        found.unhashed.append(str(path))
    return table


def _said(error: QuadexpError, path: Path) -> str:
    return str(error).removeprefix(f"{path}: ").partition(";")[0].partition(": make it again")[0]


def _unlike(listed: Rows, rows: dict[str, Row], there: set[str]) -> Iterator[str]:
    """What of a table is not what the flights say, in one line, or nothing."""
    names = [name for name in ROW_COLUMNS if name != "variant"]  # a sweep's own name for what varies in it
    other, lost = [], []
    for row in listed:
        key = row["key"]
        if key in rows:
            mine = to_columns([{**rows[key], "key": key}])
            theirs = to_columns([row])
            other += [f"{key} ({name})" for name in names if not _same(mine[name][0], theirs[name][0])][:1]
        elif key not in there and row["outcome"] != "failed":
            lost.append(key)
    said = {"are not what their flights say": other, "are of flights that are not there": lost}
    parts = [f"{len(found)} rows {what}, the first {found[0]}" for what, found in said.items() if found]
    if parts:
        yield "; ".join(parts)


def _same(a: Any, b: Any) -> bool:
    return bool(a == b or (a != a and b != b))


def _made(root: Path, record: dict[str, Any], found: Verified) -> None:
    """Look at what was made of the rows."""
    made = record.get("made", {})
    found.files += sum((root / name).is_file() for name in made)
    found.wrong |= altered_texts(root, record)
    for name in made:
        if not (root / name).is_file():
            found.wrong[str(root / name)] = "is not there"
    table = _table(root / FILE, "statistics", found)
    if table and record.get("statistics", table[1].get("fingerprint")) != table[1].get("fingerprint"):
        found.wrong[str(root / FILE)] = f"is not of the rows of {RESULTS}"
    if not made:
        texts = [str(root / name) for name in TEXTS if (root / name).is_file()]
        found.files += len(texts)
        found.unhashed += texts
