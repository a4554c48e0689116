"""What lies in a folder of results: list, filter, sort, prune.

The rows of the last sweep stand in its table. Cells that are not in it, left by earlier sweeps into the same folder,
are read from their own records; they count as no longer wanted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from quadexp.errors import DataError, UsageError
from quadexp.experiment.identity import digest
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_metadata, read_table
from quadexp.messages import suggestion
from quadexp.report.tables import ROW_COLUMNS, TEXT_COLUMNS
from quadexp.sweep.keys import without_places
from quadexp.sweep.rows import Rows
from quadexp.sweep.sweep_table import RESULTS, UNFINISHED, write_results

WANTED = "wanted"  # beside the columns of a result row: whether the last sweep asked for the cell
FAILURES = ("failed", "infeasible", "lost", "solver_failed", "damaged")
# What a sweep makes of its rows.
MADE = (RESULTS, "results.csv", "statistics.parquet", "statistics.csv", "table.md", "table.tex", "comparison.tex")

Row = dict[str, Any]


@dataclass(frozen=True)
class Pruned:
    """keys: of the cells. size: bytes of their files. removed: whether they are gone."""

    keys: list[str]
    size: int
    removed: bool


def list_results(
    out: str | Path, filters: Sequence[str] = (), *, sort: str | None = None, failures: bool = False
) -> list[Row]:
    """Rows of all cells of a folder, each with `wanted`.

    filters: KEY=VALUE, all of which must hold; VALUE may be a comma list, and of text a pattern such as `gp_*`.
    sort: a column, "-" before it for descending order; what is not there comes last. failures: only what did not end
    well.
    Raises UsageError for a folder without results or an unknown column.
    """
    wanted = [_filter(text) for text in filters]
    name = (sort or "").removeprefix("-")
    if sort:
        _check_column(name)
    store = _open(out)
    rows = [row for row in _all_rows(store) if all(holds(row) for holds in wanted)]
    if failures:
        rows = [row for row in rows if row["outcome"] in FAILURES]
    if sort:
        there = [row for row in rows if not _is_missing(row[name])]
        there.sort(key=lambda row: row[name], reverse=sort.startswith("-"))
        rows = there + [row for row in rows if _is_missing(row[name])]
    return rows


def prune(out: str | Path, filters: Sequence[str] = (), *, remove: bool = False) -> Pruned:
    """Remove cells: those that the filters name, or without filters those that the last sweep did not ask for.

    remove: False only says what would go. The table is written anew where rows of it go.
    """
    store = _open(out)
    if not filters and not (store.root / RESULTS).exists():
        raise UsageError(f"{store.root}: no {RESULTS} says which cells are wanted: name the others by KEY=VALUE")
    rows = list_results(out, filters or [f"{WANTED}=false"])
    there = store.done()
    keys = [row["key"] for row in rows if row["key"] in there]
    size = sum(store.path(key).stat().st_size for key in keys)
    if remove and keys:
        with store.lock():
            conditions = {_condition(store, key) for key in keys}
            store.remove(keys)
            _shorten_table(store.root, set(keys), conditions)
    return Pruned(keys, size, remove)


def _open(out: str | Path) -> CellStore:
    store = CellStore(out)
    if not store.folder.is_dir() and not (store.root / RESULTS).exists():
        raise UsageError(f"{out}: holds no results (made by `quadexp evaluate`)")
    return store


def _all_rows(store: CellStore) -> Iterable[Row]:
    seen: set[str] = set()
    for path in (store.root / RESULTS, store.folder / UNFINISHED):
        if path.exists():
            columns, _ = read_table(path, "results")
            for row in Rows.of(columns):
                if row["key"] not in seen:
                    seen.add(row["key"])
                    yield {**row, WANTED: True}
    has_table = (store.root / RESULTS).exists()
    for key in sorted(store.done() - seen):
        empty = {name: "" if name in TEXT_COLUMNS else None for name in ROW_COLUMNS}
        try:
            yield {**empty, **store.row(key), WANTED: not has_table}
        except (DataError, UsageError, KeyError) as error:
            yield {**empty, "key": key, "outcome": "damaged", "cause": str(error), WANTED: False}


def _filter(text: str) -> Callable[[Row], bool]:
    name, equals, value = text.partition("=")
    if not equals:
        raise UsageError(f"{text!r}: expected KEY=VALUE, such as controller=gp_mpc")
    _check_column(name)
    allowed = value.split(",")

    def holds(row: Row) -> bool:
        found = row[name]
        if isinstance(found, bool):
            return str(found).lower() in map(str.lower, allowed)
        if isinstance(found, str):
            return any(fnmatchcase(found, pattern) for pattern in allowed)
        return any(_same_number(found, text) for text in allowed)

    return holds


def _same_number(found: float | None, text: str) -> bool:
    if _is_missing(found):
        return text in ("", "null")
    try:
        return float(text) == found
    except ValueError:
        return False


def _is_missing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def _check_column(name: str) -> None:
    known = (*ROW_COLUMNS, WANTED)
    if name not in known:
        raise UsageError(f"{name}: no such column{suggestion(name, known)}")


def _condition(store: CellStore, key: str) -> str:
    try:
        return digest(without_places(read_metadata(store.path(key), "flight")["config"]))
    except (DataError, KeyError):
        return ""


def _shorten_table(root: Path, keys: set[str], conditions: set[str]) -> None:
    if not (root / RESULTS).exists():
        return
    columns, record = read_table(root / RESULTS, "results")
    kept = [key not in keys for key in columns["key"]]
    if all(kept):
        return
    if not any(kept):
        for name in MADE:
            (root / name).unlink(missing_ok=True)
        return
    record["conditions"] = sorted(set(record.get("conditions", ())) - conditions)
    write_results(root, Rows.of({name: values[kept] for name, values in columns.items()}), record)
