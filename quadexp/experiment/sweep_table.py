"""The rows of a sweep while it runs: what earlier runs left, what comes in, and now and then a copy on disk.

A row stands in the footer of its cell; reading it costs half a millisecond, so a sweep that goes on reads the table of
the run before, and footers only of what is newer. While a sweep is not finished its rows lie in cells/rows.parquet.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, QuadexpError, UsageError
from quadexp.experiment.plan import Plan
from quadexp.experiment.rows import Rows
from quadexp.flight.cell_store import CellStore
from quadexp.flight.store import read_metadata, read_table, write_table, write_text
from quadexp.report.outside import outside_notes
from quadexp.report.statistics_file import Statistics, results_statistics, write_comparison
from quadexp.report.tables import ErrorTable, to_csv

RESULTS = "results.parquet"
UNFINISHED = "rows.parquet"
CELLS_BETWEEN = 5000  # new rows after which they are written, or a quarter of those there, whichever is more


class SweepTable:
    """Rows of a plan's cells, at the places the plan gives them."""

    def __init__(self, store: CellStore, plan: Plan) -> None:
        self._store, self._plan = store, plan
        self.rows = Rows(len(plan))
        self._unwritten = 0

    def recall(self) -> None:
        """Take the rows of all cells that are there; those that failed, or are damaged, are to be flown again."""
        importlib.import_module("pyarrow.parquet")  # fifty megabytes, which are better taken now than in mid-sweep

        done = self._store.done()
        for path in (self._store.folder / UNFINISHED, self._store.root / RESULTS):
            if path.exists():
                self._recall_table(path, done)
        for key, place in self._plan.places.items():
            if key in done and not self.rows.filled[place]:
                with contextlib.suppress(DataError, UsageError):
                    self._set(key, self._store.row(key))

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

    def _recall_table(self, path: Path, done: set[str]) -> None:
        try:
            columns, _ = read_table(path, "results", required=("key", "outcome"))
        except (DataError, UsageError):  # nothing is lost: the footers say the same
            return
        places = self._plan.places
        found = [
            (i, places[key])
            for i, (key, outcome) in enumerate(zip(columns["key"], columns["outcome"], strict=True))
            if key in done and key in places and outcome != "failed" and not self.rows.filled[places[key]]
        ]
        if found:
            chosen, at = np.array(found).T
            varied = np.array([self._plan.varied[place] for place in at], dtype=object)
            self.rows.put(at, {**columns, "variant": _scattered(varied, chosen, len(columns["key"]))}, chosen)


def write_results(root: Path, rows: Rows, record: Mapping[str, Any]) -> tuple[Statistics, ErrorTable, dict[str, str]]:
    """Write the rows and all that is made from them; returns statistics, the error table and name -> path.

    record: metric of the table, baseline and confidence of the statistics, and what else goes with the rows. Rows that
    lie there already with the same record are left as they are.
    """
    statistics = results_statistics(root, rows, baseline=record["baseline"], confidence=record["confidence"])
    files = {"results": root / RESULTS, "csv": root / "results.csv"}
    if not _lies_there(root, rows, record):
        write_text(files["csv"], to_csv(rows))
        write_table(files["results"], rows.columns(), record, "results")
    table, made = write_comparison(root, statistics, record["metric"], outside_notes(rows))
    return statistics, table, {name: str(path) for name, path in files.items()} | made


def _give_back_memory() -> None:
    """What writing took for a moment goes back to the system, or the driver would grow with every copy of the rows."""
    import pyarrow as pa

    pa.default_memory_pool().release_unused()
    with contextlib.suppress(OSError, AttributeError):  # glibc's alone
        ctypes.CDLL(None).malloc_trim(0)


def _lies_there(root: Path, rows: Rows, record: Mapping[str, Any]) -> bool:
    """Whether the files hold these rows; when and where they were made takes no part."""
    try:
        stored = read_metadata(root / RESULTS, "results")
        asked = json.loads(json.dumps({name: value for name, value in record.items() if name != "provenance"}))
        if not (root / "results.csv").is_file() or any(stored.get(name) != asked[name] for name in asked):
            return False
        columns, _ = read_table(root / RESULTS, "results")
    except QuadexpError:
        return False
    return columns.keys() == rows.columns().keys() and all(
        _same(values, columns[name]) for name, values in rows.columns().items()
    )


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def _scattered(values: np.ndarray, places: np.ndarray, length: int) -> np.ndarray:
    out = np.full(length, "", dtype=object)
    out[places] = values
    return out
