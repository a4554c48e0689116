"""What this program exports: csv under the names of a flight's columns, and tum. Both are logs like any other."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from quadexp.errors import DataError
from quadexp.log.importers.mapping import QUANTITIES, ROTORS, Crop, columns_of
from quadexp.log.importers.raw import RawLog, clean_stream
from quadexp.log.importers.table import Table, kind_of, open_table
from quadexp.log.schema import FLIGHT_COLUMNS, describe

ABOUT = "csv and tum of `quadexp export`"
PARQUET = b"PAR1"
TUM_HEADERS = ("t x y z qx qy qz qw", "timestamp tx ty tz qx qy qz qw", "timestamp x y z qx qy qz qw")


def recognises(path: Path, head: bytes | None) -> int:
    if head is None or kind_of(path, head) != "text":
        return 2 * (head or b"").startswith(PARQUET)
    table = open_table(path)
    return 2 * (_is_csv(table) or _is_tum(table))


def read(path: Path, named: str) -> RawLog:
    """Streams in the units and frames of a flight's columns, rotors in the vehicle's order. Raises DataError."""
    with open(path, "rb") as file:
        if file.read(len(PARQUET)) == PARQUET:
            raise DataError(f"{path}: Parquet: a flight of this program needs no import, use it as it is")
    table, notes = open_table(path), list[str]()
    if _is_tum(table):
        return _tum(table)
    columns = table.read(table.columns, notes)
    log = RawLog("csv", {}, "quadexp", notes=notes)
    for quantity, (names, *_) in QUANTITIES.items():
        if quantity in ROTORS:
            names = columns_of(quantity, sum(c.startswith(names[0].format("")) for c in columns))
        if names and set(names) <= set(columns):
            values = np.stack([columns[name] for name in names], axis=1)
            log.streams[quantity] = clean_stream(path, quantity, columns["t"], values, notes)
    return log


def _is_csv(table: Table) -> bool:
    columns = table.columns
    return {"t", "p_x", "q_w"} <= set(columns) and all(c in FLIGHT_COLUMNS or describe(c).unit for c in columns)


def _is_tum(table: Table) -> bool:
    """Whether a table is a trajectory in the TUM format: eight columns, by their names or by none."""
    names = " ".join(table.columns)
    return len(table.columns) == 8 and table.delimiter == " " and (names in TUM_HEADERS or names == "0 1 2 3 4 5 6 7")


def _tum(table: Table) -> RawLog:
    log = RawLog("tum", {}, "tum")
    columns = list(table.read(table.columns, log.notes).values())
    pose = np.stack(columns[1:], axis=1)
    log.streams["position"] = clean_stream(table.path, "position", columns[0], pose[:, :3], log.notes)
    log.streams["attitude"] = clean_stream(table.path, "attitude", columns[0], pose[:, [6, 3, 4, 5]], log.notes)
    if " ".join(table.columns) == TUM_HEADERS[0]:
        log.crop = Crop("none")
    return log
