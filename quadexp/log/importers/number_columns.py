"""The columns of a table that hold numbers, found by reading it."""

from __future__ import annotations

import numpy as np

from quadexp.errors import DataError
from quadexp.log.importers.table import Table, split

MOST_ROWS = 300_000
MOST_COLUMNS = 400


def numbers(table: Table) -> tuple[list[str], np.ndarray]:
    """The columns that hold numbers, and their values (k, N).

    At most MOST_COLUMNS and MOST_ROWS are looked at; of datasets of several lengths, the length most columns have.
    Raises DataError where no column holds numbers.
    """
    names = list(table.columns[:MOST_COLUMNS])
    if not table.hdf5:
        rows = _head(table)
        names = [n for i, n in enumerate(names) if all(_number(row[i]) for row in rows)]
    while True:
        try:
            columns = table.read(names, [], MOST_ROWS)
            break
        except DataError as error:
            bad = next((name for name in names if f"column {name!r} holds" in str(error)), None)
            if bad is None:
                raise
            names.remove(bad)
    lengths = {len(values) for values in columns.values()}
    if len(lengths) > 1:
        longest = max(lengths, key=lambda n: sum(len(values) == n for values in columns.values()))
        names = [name for name in names if len(columns[name]) == longest]
    if not names:
        raise DataError(f"{table.path}: no column of numbers")
    return names, np.stack([columns[name] for name in names], axis=1)


def _head(table: Table) -> list[list[str]]:
    with open(table.path, encoding=table.encoding, errors="replace") as file:
        lines = [line for _, line in zip(range(table.skip + 200), file, strict=False)][table.skip :]
    rows = [split(line.rstrip("\r\n"), table.delimiter) for line in lines]
    return [row for row in rows if len(row) == len(table.columns)]


def _number(text: str) -> bool:
    try:
        float(text or "nan")
    except ValueError:
        return text.lower() in ("na", "null", "none")
    return True
