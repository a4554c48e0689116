"""What this program wrote, back as a flight: Parquet and csv, by the record in it or beside it. Nothing is resampled
or cropped. A csv with the names of a flight's columns and no record beside it, and tum, are logs like any other.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.log.importers.mapping import QUANTITIES, ROTORS, Crop, columns_of
from quadexp.log.importers.raw import RawLog, clean_stream
from quadexp.log.importers.table import Table, kind_of, open_table
from quadexp.log.schema import FLIGHT_COLUMNS, Flight, describe
from quadexp.log.store import first_line, read_table

INTEGERS = {"status": np.int8, "sweeps": np.int16, "active": np.int16, "unconverged": np.int8, "segment": np.int32}
TUM_HEADERS = ("t x y z qx qy qz qw", "timestamp tx ty tz qx qy qz qw", "timestamp x y z qx qy qz qw")


ABOUT = "what this program wrote: Parquet, csv, tum"
FOR_LOOKING_AT = (b"\x89MCAP0\r\n", b"RRF2", b"RRIO")  # exports that are not read back


def recognises(path: Path, head: bytes | None) -> int:
    if head is None:
        return 0
    if head.startswith((b"PAR1", *FOR_LOOKING_AT[1:])) or (
        head.startswith(FOR_LOOKING_AT) and b"quadexp " in head[:256]
    ):
        return 2
    if kind_of(path, head) != "text":
        return 0
    table = open_table(path)
    return 2 * (_is_csv(table) or _is_tum(table))


def read(path: Path, named: str) -> Flight | RawLog:
    """A flight as it was written; a RawLog from tum, and from a csv without its record. Raises DataError."""
    with open(path, "rb") as file:
        head = file.read(8)
    if head.startswith(FOR_LOOKING_AT):
        raise DataError(f"{path}: an export is for looking at and cannot be read back: import the flight's Parquet")
    if head.startswith(b"PAR1"):
        columns, record = read_table(path, "flight", required=("t",))
        return Flight(columns, record)
    table = open_table(path)
    if _is_tum(table):
        return _tum(table)
    notes: list[str] = []
    columns, beside = table.read(table.columns, notes), _record(path)
    return _streams(path, columns, notes) if beside is None else Flight(_typed(columns), beside)


def _is_csv(table: Table) -> bool:
    columns = table.columns
    return {"t", "p_x", "q_w"} <= set(columns) and all(c in FLIGHT_COLUMNS or describe(c).unit for c in columns)


def _is_tum(table: Table) -> bool:
    """Whether a table is a trajectory in the TUM format: eight columns, by their names or by none."""
    names = " ".join(table.columns)
    return len(table.columns) == 8 and table.delimiter == " " and (names in TUM_HEADERS or names == "0 1 2 3 4 5 6 7")


def _streams(path: Path, columns: dict[str, np.ndarray], notes: list[str]) -> RawLog:
    """A log under the names of a flight's columns, so in their units and frames, and the vehicle's order of rotors."""
    log = RawLog("csv", {}, "quadexp", notes=notes)
    for quantity, (names, *_) in QUANTITIES.items():
        if quantity in ROTORS:
            names = columns_of(quantity, sum(c.startswith(names[0].format("")) for c in columns))
        if names and set(names) <= set(columns):
            values = np.stack([columns[name] for name in names], axis=1)
            log.streams[quantity] = clean_stream(path, quantity, columns["t"], values, notes)
    return log


def _typed(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    for name, dtype in INTEGERS.items():
        if name in columns and np.isfinite(columns[name]).all():
            columns[name] = columns[name].astype(dtype)
    return columns


def _record(path: Path) -> dict[str, Any] | None:
    """The record beside a csv, where it still lies there."""
    file = path.with_name(f"{path.name}.json")
    if not file.is_file():
        return None
    try:
        record = json.loads(file.read_text(encoding="utf-8"))["record"]
        return dict(record)
    except (ValueError, KeyError, TypeError, OSError, RecursionError) as error:
        raise DataError(f"{file}: damaged ({first_line(error)}); remove it to import the table alone") from None


def _tum(table: Table) -> RawLog:
    notes: list[str] = []
    columns = list(table.read(table.columns, notes).values())
    pose = np.stack(columns[1:], axis=1)
    log = RawLog("tum", {}, "tum", notes=notes)
    log.streams["position"] = clean_stream(table.path, "position", columns[0], pose[:, :3], notes)
    log.streams["attitude"] = clean_stream(table.path, "attitude", columns[0], pose[:, [6, 3, 4, 5]], notes)
    if " ".join(table.columns) == TUM_HEADERS[0]:
        log.crop = Crop("none")
    return log
