"""The table of a sweep: one row a cell, and the files that are made from the rows.

The row of a cell stands in the file of its flight; tables are written from the flights and are never read back into a
sweep.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.errors import QuadexpError, UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_table, write_table
from quadexp.names import NAMED, check_names, sha256_of
from quadexp.parts.former import hashed
from quadexp.report.frame import RESULTS
from quadexp.report.metrics import (
    TEXT_COLUMNS,
    declare_record,
    errors_none,
    from_columns,
    row_columns,
    to_columns,
    to_csv,
    typed,
)
from quadexp.report.statistics import Statistics, results_statistics
from quadexp.report.table import Table
from quadexp.report.tables import comparison_texts, write_comparison
from quadexp.writer import write_text

OPTIONAL = ("speed", "reference_residual", "outside_data")  # numbers that not every flight has: None where missing

Row = dict[str, Any]


def condition(record: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a flight's record that was asked for: without the places where a checkpoint was looked for."""
    return {**hashed(dict(record)), "controller": {k: v for k, v in record["controller"].items() if k != "models"}}


def open_results(out: str | Path) -> CellStore:
    """The cells of a folder of results; raises UsageError where there are none."""
    store = CellStore(out)
    if not store.folder.is_dir() and not (store.root / RESULTS).exists():
        raise UsageError(f"{out}: holds no results (made by `quadexp evaluate`)")
    return store


def table_row(row: Mapping[str, Any]) -> Row:
    """A result row with every column of the table, each of its type: a missing text is empty, a missing number NaN."""
    row = {**row, **errors_none(row.get("outcome"))}
    values = {name: typed(name, row.get(name)) for name in row_columns([row])}
    values |= {name: sys.intern(values[name]) for name in TEXT_COLUMNS}  # most are shared by many rows
    return values | {name: None for name in OPTIONAL if math.isnan(values[name])}


def read_rows(path: Path) -> tuple[list[Row], dict[str, Any]]:
    """Rows and record of a table of results; raises DataError where it is damaged."""
    columns, record = read_table(path, "results", required=("key", "outcome"))
    for name in NAMED:
        for value in {*columns.get(name, ())}:
            check_names({name: value}, str(path))
    declare_record(record)
    return [table_row(row) for row in from_columns(columns)], record


def write_results(
    root: Path, rows: Sequence[Row], record: Mapping[str, Any], *, write: bool = True
) -> tuple[Statistics, Table, dict[str, str], list[str]]:
    """Write the rows and all that is made from them; returns statistics, the error table, name -> path, and a line for
    each file that no longer held what was written.

    record: metric of the table, baseline and confidence of the statistics, and what else goes with the rows. write:
    False only makes statistics and table.
    """
    statistics = results_statistics(rows, baseline=record["baseline"], confidence=record["confidence"])
    table, texts = comparison_texts(statistics, record["metric"])
    if not write:
        return statistics, table, {}, []
    csv = to_csv(rows)
    columns = to_columns(rows)
    path = root / RESULTS
    hashes = {name: sha256_of(text) for name, text in {**texts, "results.csv": csv}.items()}
    record = {**record, "made": hashes, "statistics": statistics.fingerprint}
    wrong = []
    if path.exists():
        try:
            wrong = [f"{name}: {what}" for name, what in altered_texts(root, read_table(path, "results")[1]).items()]
        except QuadexpError as error:
            wrong = [str(error)]
    write_text(root / "results.csv", csv)
    write_table(path, columns, record, "results")
    paths = write_comparison(root, statistics, texts)
    files = {"results": str(path), "csv": str(root / "results.csv"), **paths}
    return statistics, table, files, [f"{what}: written anew" for what in wrong]


def altered_texts(root: Path, record: Mapping[str, Any]) -> dict[str, str]:
    """Path -> what is wrong, of the text files that are not those written with a table of results of this record."""
    texts = {root / name: digest for name, digest in record.get("made", {}).items() if (root / name).is_file()}
    return {
        str(path): f"is not what was written with {RESULTS} (edited, or a run was ended between the two)"
        for path, digest in texts.items()
        if sha256_of(path.read_bytes()) != digest
    }
