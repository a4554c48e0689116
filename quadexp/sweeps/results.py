"""What a folder of results holds: list, filter, sort, prune.

The rows of the last sweep stand in its table. Cells that are not in it are read from their own files. Wanted are those
of the table, and those that a run asked for which has not ended; cells of earlier sweeps into the same folder are not.
What is removed is chosen by its own file alone.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from quadexp.errors import DataError, UsageError
from quadexp.experiment.identity import digest
from quadexp.log.cell_store import CellStore
from quadexp.log.outcome import FAILURES
from quadexp.parts.settings import read_value
from quadexp.report.condition import chosen
from quadexp.report.frame import RESULTS, SweepFrame
from quadexp.sweeps.sweep_table import condition, open_results, read_rows, table_row, write_results

WANTED = "wanted"  # beside the columns of a result row: whether the last sweep, or one that has not ended, asked for it
# What a sweep makes of its rows.
MADE = (RESULTS, "results.csv", "statistics.parquet", "statistics.csv", "table.md", "table.tex", "comparison.tex")


@dataclass(frozen=True)
class Pruned:
    """frame: of the cells. size: bytes of their files. removed: whether they are gone."""

    frame: SweepFrame
    size: int
    removed: bool

    @property
    def keys(self) -> list[str]:
        return [row["key"] for row in self.frame.rows]


def select(
    out: str | Path,
    filters: Sequence[str] = (),
    *,
    where: str | None = None,
    sort: str | None = None,
    failures: bool = False,
) -> SweepFrame:
    """The cells of a folder, with any key of the configuration as a column, and `wanted`.

    filters: KEY=VALUE, all of which must hold; VALUE may be a comma list, and of text a pattern such as `*_mpc`. where:
    see report/condition.py. sort: columns with commas between, "-" before one for descending order; what comes first
    decides first, and missing values come last. failures: only what was not completed.
    Raises UsageError for a folder without results or an unknown column.
    """
    frame = _filtered(_frame(open_results(out))[0], filters)
    if failures:
        frame = frame.where([row["outcome"] in (*FAILURES, "invalid", "damaged") for row in frame.rows])
    if where:
        frame = frame.where(chosen(frame, where))
    order = list(range(len(frame.rows)))
    for key in reversed((sort or "").split(",") if sort else []):
        column = frame.column(key.strip().removeprefix("-"))
        down = key.strip().startswith("-")
        there = [i for i in order if column[i] is not None]
        texts = not all(isinstance(column[i], (int, float)) for i in there)
        there.sort(key=lambda i: str(column[i]) if texts else column[i], reverse=down)
        order = there + [i for i in order if column[i] is None]
    return frame.taken(order)


def prune(out: str | Path, filters: Sequence[str] = (), *, remove: bool = False) -> Pruned:
    """Remove cells: those that the filters name, or without filters those that are not wanted.

    remove: False only says which. The table is written anew where it loses rows.
    """
    store = open_results(out)
    others = "name the others by KEY=VALUE"
    if not filters and not (store.root / RESULTS).exists():
        raise UsageError(f"{store.root}: no {RESULTS} says which cells are wanted: {others}")
    if not filters:
        try:
            store.asked()
        except DataError as error:
            raise UsageError(f"{error}: {others}") from None
    with store.lock() if remove else contextlib.nullcontext():
        frame, configs = _frame(store, every_file=True)
        frame = _filtered(frame, filters or [f"{WANTED}=false"])
        keys = [row["key"] for row in frame.rows]
        size = sum(store.path(key).stat().st_size for key in keys)
        if remove and keys:
            store.remove(keys)
            conditions = {digest(condition(configs[key])) for key in keys if "controller" in configs.get(key, {})}
            _shorten_table(store.root, set(keys), conditions)
    return Pruned(frame, size, remove)


def _frame(store: CellStore, *, every_file: bool = False) -> tuple[SweepFrame, dict[str, dict[str, Any]]]:
    """All cells, and key -> settings of those whose own file was read. every_file: read every file, and list nothing
    else."""
    path = store.root / RESULTS
    rows, record = read_rows(path) if path.exists() else ([], {})
    listed = {row["key"]: row for row in rows}
    there = store.done()
    try:
        wanted = {*listed, *store.asked()}
    except DataError:  # nobody knows: all
        wanted = {*listed, *there}
    cells = [] if every_file else [{**row, WANTED: True} for row in rows]
    configs: dict[str, dict[str, Any]] = {}
    for key in sorted(there if every_file else there - listed.keys()):
        row = listed.get(key, {})
        try:
            stored = store.record(key)
            configs[key] = stored.get("config") or {}
            row = {**stored["row"], "variant": row.get("variant")}
        except (DataError, UsageError) as error:
            row = {"key": key, "outcome": "damaged", "cause": str(error)}
        cells.append({**table_row(row), WANTED: key in wanted or not path.exists()})
    return SweepFrame(cells, store.root, record, configs), configs


def _filtered(frame: SweepFrame, filters: Sequence[str]) -> SweepFrame:
    for text in filters:
        name, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"{text!r}: expected KEY=VALUE, such as controller=nominal_mpc")
        allowed, column = (
            re.split(r",(?![^\[]*\])", value),
            frame.column(name),
        )  # a comma inside brackets is one of a value
        frame = frame.where([any(_matches(cell, text) for text in allowed) for cell in column])
    return frame


def _matches(cell: Any, allowed: str) -> bool:
    """Whether a value of a row is the one allowed: a text by its pattern, a number or a list by its value."""
    if cell is None:
        return allowed in ("", "null")
    value = read_value(allowed)
    if isinstance(cell, str) and fnmatchcase(cell, allowed):
        return True
    return bool(cell == value) and isinstance(cell, bool) is isinstance(value, bool)


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
