"""The rows of a sweep while it runs: what earlier runs left, what comes in, and now and then a copy on disk.

A row stands in the file of its cell, and is taken from there whenever a sweep goes on: the hash of every byte is
checked on the way, which costs .4 ms of processor time a flight of 20 s. Tables are written from rows and never
believed. While a sweep is not finished its rows lie in cells/rows.parquet too, for `quadexp results`.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib
import json
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, QuadexpError, UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import has_content_hash, read_table, read_text, write_table, write_text
from quadexp.provenance import sources
from quadexp.report.statistics_file import (
    Statistics,
    comparison_texts,
    results_statistics,
    statistics_csv,
    write_comparison,
)
from quadexp.report.tables import ErrorTable, to_csv
from quadexp.sweep.engine import default_workers
from quadexp.sweep.plan import Plan
from quadexp.sweep.rows import Rows

RESULTS = "results.parquet"
UNFINISHED = "rows.parquet"
READERS, AT_ONCE = 4, 1000  # threads that read cells, and cells that are given to them together
CELLS_BETWEEN = 5000  # new rows after which they are written, or a quarter of those there, whichever is more


class SweepTable:
    """Rows of a plan's cells, at the places the plan gives them."""

    def __init__(self, store: CellStore, plan: Plan) -> None:
        self._store, self._plan = store, plan
        self.rows = Rows(len(plan))
        self.changed: dict[str, str] = {}  # key -> what is wrong with a file that was there
        self._unwritten = 0

    def recall(self) -> None:
        """Take the rows of all cells that are there; those that failed, or whose file has changed, are to be flown
        again."""
        importlib.import_module("pyarrow.parquet")  # fifty megabytes, which are better taken now than in mid-sweep

        done = self._store.done()
        keys = [key for key in self._plan.places if key in done]
        with ThreadPoolExecutor(min(READERS, default_workers())) as readers:
            for first in range(0, len(keys), AT_ONCE):
                some = keys[first : first + AT_ONCE]
                for key, row in zip(some, readers.map(self._read, some), strict=True):
                    if isinstance(row, QuadexpError):
                        self.changed[key] = str(row)
                    else:
                        self._set(key, row)

    def _read(self, key: str) -> dict[str, Any] | QuadexpError:
        try:
            return self._store.row(key)
        except (DataError, UsageError) as error:
            return error

    def flown_elsewhere(self) -> dict[str, dict[str, Any]]:
        """Key -> row of the cells that other sources have flown than those that run."""
        there, own, mine = self.rows.filled, self.rows.column("sources"), sources()
        return {
            key: self.rows[place] for key, place in self._plan.places.items() if there[place] and own[place] != mine
        }

    def libraries(self) -> list[str]:
        """The libraries of every row."""
        return self.rows.column("libraries")[self.rows.filled].tolist()

    def forget(self, keys: Iterable[str]) -> None:
        """Have these cells flown again: their files and rows go."""
        keys = list(keys)
        self._store.remove(keys)
        self.rows.filled[[self._plan.places[key] for key in keys]] = False

    def lacking(self) -> list[str]:
        """Keys of the cells without a row."""
        return [key for key, place in self._plan.places.items() if not self.rows.filled[place]]

    def add(self, key: str, row: Mapping[str, Any]) -> None:
        """A cell was flown."""
        self._set(key, row)
        self._unwritten += 1
        if self._unwritten >= max(CELLS_BETWEEN, int(self.rows.filled.sum()) // 4):
            write_table(self._store.folder / UNFINISHED, self.rows.columns(), {}, "results")
            self._unwritten = 0
            _give_back_memory()

    def settled(self) -> None:
        """The rows lie in the table of results now."""
        (self._store.folder / UNFINISHED).unlink(missing_ok=True)

    def _set(self, key: str, row: Mapping[str, Any]) -> None:
        place = self._plan.places[key]
        self.rows[place] = {**row, "key": key, "variant": self._plan.varied[place]}


def write_results(
    root: Path, rows: Rows, record: Mapping[str, Any]
) -> tuple[Statistics, ErrorTable, dict[str, str], list[str]]:
    """Write the rows and all that is made from them; returns statistics, the error table, name -> path, and a line for
    each file that no longer held what was written.

    record: metric of the table, baseline and confidence of the statistics, and what else goes with the rows. Rows that
    lie there already with the same record are left as they are.
    """
    options = {name: record[name] for name in ("baseline", "confidence")}
    statistics, csv = results_statistics(root, rows, **options), to_csv(rows)
    files = {"results": root / RESULTS, "csv": root / "results.csv"}
    texts = comparison_texts(statistics, record["metric"])[1]
    texts |= {"results.csv": csv, "statistics.csv": statistics_csv(statistics.rows)}
    made = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}
    record = {**record, "made": made, "statistics": statistics.fingerprint}
    stored, wrong = _stored(files["results"])
    wrong += [f"{path}: {what}" for path, what in altered_texts(root, stored[1]).items()] if stored else []
    if read_text(files["csv"]) != csv:
        write_text(files["csv"], csv)
    if stored is None or not _same_table(*stored, rows, record) or not has_content_hash(files["results"]):
        write_table(files["results"], rows.columns(), record, "results")
    table, paths = write_comparison(root, statistics, record["metric"])
    altered = [f"{what}: written anew" for what in wrong]
    return statistics, table, {name: str(path) for name, path in files.items()} | paths, altered


def altered_texts(root: Path, record: Mapping[str, Any]) -> dict[str, str]:
    """Path -> what is wrong, of the text files that are not those written with a table of results of this record."""
    texts = {root / name: digest for name, digest in record.get("made", {}).items() if (root / name).is_file()}
    return {
        str(path): f"is not what was written with {RESULTS} (edited, or a run was ended between the two)"
        for path, digest in texts.items()
        if hashlib.sha256(path.read_bytes()).hexdigest() != digest
    }


def _stored(path: Path) -> tuple[tuple[dict[str, Any], dict[str, Any]] | None, list[str]]:
    """Columns and record of a table of results, and what is wrong with it if it is there."""
    try:
        return read_table(path, "results"), []
    except QuadexpError as error:
        return None, [str(error)] if path.exists() else []


def _give_back_memory() -> None:
    """What writing took for a moment goes back to the system, or the driver would grow with every copy of the rows."""
    import pyarrow as pa

    pa.default_memory_pool().release_unused()
    with contextlib.suppress(OSError, AttributeError):  # glibc's alone
        ctypes.CDLL(None).malloc_trim(0)


def _same_table(columns: Mapping[str, Any], stored: Mapping[str, Any], rows: Rows, record: Mapping[str, Any]) -> bool:
    """Whether a stored table holds these rows; when and where they were made takes no part."""
    asked = json.loads(json.dumps({name: value for name, value in record.items() if name != "provenance"}))
    mine = rows.columns()
    return (
        all(stored.get(name) == asked[name] for name in asked)
        and columns.keys() == mine.keys()
        and all(_same(values, columns[name]) for name, values in mine.items())
    )


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
