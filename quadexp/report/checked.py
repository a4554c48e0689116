"""What numbers are worth: whether the flights behind the rows of a table are there and say the same.

`report`, `results`, `compare` and `plot` look at so many files, evenly chosen; `quadexp results --verify` reads all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from quadexp.errors import QuadexpError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_table
from quadexp.report.metrics import errors_none
from quadexp.report.result_rows import ROW_COLUMNS, from_columns
from quadexp.report.text import count

MOST = 500  # files that are looked at
COMPARED = [name for name in ROW_COLUMNS if name != "variant"]  # which the sweep gives, not the flight


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
        what = {
            "cannot be read, or were edited since they were written": self.unreadable,
            "say something else than the table, which may be of another sweep": self.other,
            "are not in this folder: the table may be of another sweep": self.missing,
        }
        of = f"of {self.looked} files of flights that were checked"
        lines = [f"{len(keys)} {of} {fault} (the first: {keys[0]})" for fault, keys in what.items() if keys]
        if beside and self.beside:
            lines.append(f"{count(self.beside, 'file')} of flights in this folder belong to another sweep: not shown")
        return lines

    def text(self) -> str:
        """How much was checked, in a sentence."""
        bad = len(self.missing) + len(self.unreadable) + len(self.other)
        what = "all hold what the table says" if not bad else f"{self.looked - bad} hold what the table says"
        return f"{self.looked} of {count(self.flights, 'file')} of flights checked: {what}"


def rows_of(results: str | Path) -> tuple[Path, list[dict[str, Any]]]:
    """Folder and rows of results."""
    path = Path(results)
    file = path / "results.parquet" if path.is_dir() else path
    return file.parent, from_columns(read_table(file, "results")[0])


def check_flights(root: str | Path, rows: Sequence[Mapping[str, Any]], most: int = MOST) -> Checked:
    """Compare rows of results with the files of their flights in the folder `root`."""
    store = CellStore(root)
    flown = [row for row in rows if row["outcome"] not in ("failed", "invalid", "damaged")]
    chosen, there = flown[:: max(1, -(-len(flown) // most))], store.done()
    missing, unreadable, other = [], [], []
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
    beside = len(there - {str(row["key"]) for row in rows})
    return Checked(len(chosen), len(flown), missing, unreadable, other, beside)


def _plain(value: Any) -> Any:
    """One value for what is missing: a table has NaN, zero or an empty text for it."""
    return None if value is None or value != value or not value else value
