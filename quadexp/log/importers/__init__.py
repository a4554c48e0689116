"""Flights from other programs' logs: which reader takes a log, what it becomes, what is left out of it.

A reader (one module of readers/ a format) makes a RawLog (streams in SI, ENU, FLU, each on its own clock), assemble.py
a flight of that.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.log.importers.assemble import assemble
from quadexp.log.importers.bad_rows import MODES, without_bad_rows
from quadexp.log.importers.mapping import Mapping, load_mapping
from quadexp.log.importers.raw import RawLog, read_mapped
from quadexp.log.importers.readers import reader_of, readers
from quadexp.log.importers.readers.csv import ready_mappings
from quadexp.log.importers.table import open_table
from quadexp.log.schema import Flight
from quadexp.log.signal import Stream
from quadexp.log.signal.offset import find_offsets
from quadexp.log.units import mounting_matrix
from quadexp.physics.vehicle import Vehicle
from quadexp.provenance import provenance, versions

TABLES = ("csv", "quadexp")  # formats that a mapping may be given for


@dataclass
class Options:
    """How to import. rate: Hz, None for the log's own. crop: whether to cut ground phases. align: whether to move the
    streams by the time offsets found. mounting, gyro_mounting: roll, pitch, yaw of the sensor in the body (deg).
    bad_rows: what becomes of rows that cannot be, a name of bad_rows.MODES."""

    format: str = "auto"
    mapping: Path | None = None
    rate: float | None = None
    crop: bool = True
    align: bool = False
    mounting: tuple[float, float, float] | None = None
    gyro_mounting: tuple[float, float, float] | None = None
    bad_rows: str = "refuse"


def checked(options: Options) -> Mapping | None:
    """The mapping that the options name; raises UsageError where the request itself is wrong."""
    if options.format not in (known := ("auto", *ready(), *readers())):
        raise UsageError(f"--log-format {options.format}: no such format; there are {', '.join(known)}")
    mapping = None if options.mapping is None else load_mapping(options.mapping)
    if mapping is None and options.format == "csv":
        raise UsageError("--log-format csv: needs --mapping FILE; `quadexp import --describe LOG` proposes one")
    if options.rate is not None and not 0.1 <= options.rate <= 10_000:
        raise UsageError(f"--rate {options.rate:g}: must be in [0.1, 10000] Hz")
    if options.bad_rows not in MODES:
        raise UsageError(f"--bad-rows {options.bad_rows}: no such way; there are {', '.join(MODES)}")
    return mapping


def import_log(
    path: Path, vehicle: Vehicle | None, options: Options, mapping: Mapping | None = None
) -> tuple[Flight, list[str]]:
    """One log as a flight, and notes. Raises UsageError or DataError with one line."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # absurd numbers are the checks' business
        log = read_log(path, options.format, mapping)
        _unmount(path, log, options)
        offsets, moved = _offsets(log, options.align)
        columns, derived = assemble(path, log, vehicle, rate=options.rate, cropping=options.crop)
        log.streams.clear()  # a long log is held once
        flight = Flight(columns, _metadata(path, log, vehicle, offsets))
        if options.bad_rows == "refuse":
            return flight, [*log.notes, *moved]
        flight, counts, left_out = without_bad_rows(flight, vehicle, options.bad_rows, derived=derived)
        if counts:
            flight.metadata["source"]["left_out"] = {"mode": options.bad_rows, "rows": counts}
        return flight, [*log.notes, *moved, *left_out]


def _unmount(path: Path, log: RawLog, options: Options) -> None:
    """Turn accelerometer and gyro into the body's axes, where the options say how they sit."""
    for name, angles in (("acceleration", options.mounting), ("rate", options.gyro_mounting)):
        if angles is None:
            continue
        if name not in log.streams:
            raise DataError(f"{path}: has no {name} that a mounting could turn")
        stream = log.streams[name]
        log.streams[name] = Stream(stream.t, stream.values @ mounting_matrix(angles).T)
        log.about.setdefault("mounting", {})[name] = list(angles)


def read_log(path: Path, form: str, mapping: Mapping | None) -> RawLog:
    """Streams of one log by the reader that recognises it."""
    kind = reader_of(path)
    asked = "csv" if form in ready() else form
    if asked not in ("auto", kind) and not (mapping is not None and {asked, kind} <= set(TABLES)):
        raise DataError(f"{path}: its content is {kind}, not --log-format {form}")
    if mapping is None:
        return readers()[kind].read(path, form)
    table = open_table(path) if kind in TABLES else None
    if table is None or mapping.format != table.format:
        kind = kind if table is None else table.format
        raise DataError(f"{path}: its content is {kind}, the mapping {mapping.name} is for {mapping.format}")
    return read_mapped(table, mapping)


def ready() -> list[str]:
    """Formats that are a ready mapping of tables."""
    return [mapping.name for mapping in ready_mappings()]


def _offsets(log: RawLog, align: bool) -> tuple[dict[str, Any], list[str]]:
    """For the record, and as notes. align: move gyro and accelerometer onto the clock of attitude and velocity, by the
    offsets that are certain."""
    record, notes = {}, []
    for (name, behind), offset in find_offsets(log.streams).items():
        removed = align and offset.certain
        if removed:
            stream = log.streams[name]
            log.streams[name] = Stream(stream.t - offset.seconds, stream.values)
        if offset.certain:
            notes.append(
                f"time offset: {name} {1e3 * offset.seconds:+.1f} ms behind {behind} (standard error"
                f" {1e3 * offset.error:.2g} ms, correlation {offset.correlation:.2f}){', removed' if removed else ''}"
            )
        record[name] = {
            "seconds": offset.seconds, "error": offset.error if np.isfinite(offset.error) else None,
            "correlation": offset.correlation, "certain": offset.certain, "behind": behind, "removed": removed,
        }  # fmt: skip
    return record, notes


def _metadata(path: Path, log: RawLog, vehicle: Vehicle | None, offsets: dict[str, Any]) -> dict[str, Any]:
    source = {"file": path.name, "sha256": digest(path), "format": log.format, "mapping": log.mapping}
    metadata: dict[str, Any] = {
        "name": path.stem, "outcome": "ok", "recorded": True, "source": source | {"offsets": offsets} | log.about,
        "versions": versions(), "provenance": provenance(),
    }  # fmt: skip
    if vehicle is not None:
        metadata["vehicle"] = {"name": vehicle.name, "fingerprint": vehicle.fingerprint}
        metadata["config"] = {"vehicle": asdict(vehicle)}
    return metadata


def digest(path: Path) -> str:
    """SHA-256 of a file, or of the names and contents of a folder's files."""
    total = hashlib.sha256()
    for file in sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]:
        total.update(file.name.encode() if path.is_dir() else b"")
        with open(file, "rb") as stream:
            hashlib.file_digest(stream, lambda: total)
    return total.hexdigest()
