"""What a folder of results holds: list, filter, sort, prune.

The rows of the last sweep stand in its table. Cells that are not in it, left by earlier sweeps into the same folder or
flown by one that has not ended, are read from their own files; where there is a table, they are not wanted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from quadexp.errors import DataError, UsageError
from quadexp.experiment.identity import digest
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_metadata
from quadexp.report.axes.frame import SweepFrame
from quadexp.report.axes.where import chosen
from quadexp.sweeps.keys import condition
from quadexp.sweeps.sweep_table import RESULTS, Row, open_results, read_rows, table_row, write_results

WANTED = "wanted"  # beside the columns of a result row: whether the last sweep asked for the cell
FAILURES = ("failed", "invalid", "infeasible", "lost", "solver_failed", "damaged")
# What a sweep makes of its rows.
MADE = (RESULTS, "results.csv", "statistics.parquet", "statistics.csv", "table.md", "table.tex", "comparison.tex")


@dataclass(frozen=True)
class Pruned:
    """keys: of the cells. size: bytes of their files. removed: whether they are gone."""

    keys: list[str]
    size: int
    removed: bool


def select(
    out: str | Path,
    filters: Sequence[str] = (),
    *,
    where: str | None = None,
    sort: str | None = None,
    failures: bool = False,
) -> SweepFrame:
    """The cells of a folder, with any key of the configuration as a column, and `wanted`.

    filters: KEY=VALUE, all of which must hold; VALUE may be a comma list, and of text a pattern such as `gp_*`. where:
    see report/axes/where.py. sort: columns with commas between, "-" before one for descending order; what comes first
    decides first, and missing values come last. failures: only what did not end well.
    Raises UsageError for a folder without results or an unknown column.
    """
    store = open_results(out)
    path = store.root / RESULTS
    frame = SweepFrame(list(_all_rows(store)), store.root, read_rows(path)[1] if path.exists() else {})
    for text in filters:
        name, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"{text!r}: expected KEY=VALUE, such as controller=gp_mpc")
        column = frame.column(name)
        frame = frame.where([any(_matches(found, allowed) for allowed in value.split(",")) for found in column])
    if failures:
        frame = frame.where([row["outcome"] in FAILURES for row in frame.rows])
    if where:
        frame = frame.where(chosen(frame, where))
    order = list(range(len(frame.rows)))
    for key in reversed((sort or "").split(",") if sort else []):
        column, down = frame.column(key.strip().removeprefix("-")), key.strip().startswith("-")
        there = [i for i in order if column[i] is not None]
        texts = not all(isinstance(column[i], (int, float)) for i in there)
        there.sort(key=lambda i: str(column[i]) if texts else column[i], reverse=down)
        order = there + [i for i in order if column[i] is None]
    return frame.taken(order)


def prune(out: str | Path, filters: Sequence[str] = (), *, remove: bool = False) -> Pruned:
    """Remove cells: those that the filters name, or without filters those that the last sweep did not ask for.

    remove: False only says which. The table is written anew where it loses rows.
    """
    store = open_results(out)
    if not filters and not (store.root / RESULTS).exists():
        raise UsageError(f"{store.root}: no {RESULTS} says which cells are wanted: name the others by KEY=VALUE")
    there = store.done()
    keys = [row["key"] for row in select(out, filters or [f"{WANTED}=false"]).rows if row["key"] in there]
    size = sum(store.path(key).stat().st_size for key in keys)
    if remove and keys:
        with store.lock():
            conditions = {_condition(store, key) for key in keys}
            store.remove(keys)
            _shorten_table(store.root, set(keys), conditions)
    return Pruned(keys, size, remove)


def _all_rows(store: CellStore) -> Iterator[Row]:
    has_table = (store.root / RESULTS).exists()
    rows = read_rows(store.root / RESULTS)[0] if has_table else []
    for row in rows:
        yield {**row, WANTED: True}
    for key in sorted(store.done() - {row["key"] for row in rows}):
        try:
            yield {**table_row(store.row(key)), WANTED: not has_table}
        except (DataError, UsageError) as error:
            yield {**table_row({"key": key, "outcome": "damaged", "cause": str(error)}), WANTED: False}


def _matches(found: Any, allowed: str) -> bool:
    """Whether a value of a row is the one allowed: a text by its pattern, a number by its value."""
    if isinstance(found, bool):
        return str(found).lower() == allowed.lower()
    if isinstance(found, str):
        return fnmatchcase(found, allowed)
    if found is None:
        return allowed in ("", "null")
    try:
        return float(allowed) == found
    except ValueError:
        return False


def _condition(store: CellStore, key: str) -> str:
    try:
        return digest(condition(read_metadata(store.path(key), "flight")["config"]))
    except (DataError, KeyError):
        return ""


def _shorten_table(root: Path, keys: set[str], conditions: set[str]) -> None:
    if not (root / RESULTS).exists():
        return
    rows, record = read_rows(root / RESULTS)
    kept = [row for row in rows if row["key"] not in keys]
    if not kept:
        for name in MADE:
            (root / name).unlink(missing_ok=True)
    elif len(kept) < len(rows):
        record["conditions"] = sorted(set(record.get("conditions", ())) - conditions)
        write_results(root, kept, record)
