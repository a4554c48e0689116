"""Flights from other programs' logs: which reader takes a log, what it becomes, what is left out of it.

A reader (one module of readers/ a format) makes a RawLog (streams in SI, ENU, FLU, each on its own clock), assemble.py
a flight of that.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.log.runs import period_of, runs
from quadexp.log.schema import Flight
from quadexp.names import distinct, named, without
from quadexp.physics.vehicle import Vehicle
from quadexp.plugin import service
from quadexp.plugins.logs.importers.assemble import SHORTEST, assemble
from quadexp.plugins.logs.importers.mapping import Mapping, load_mapping
from quadexp.plugins.logs.importers.raw import RawLog, corrected, read_mapped
from quadexp.plugins.logs.importers.readers import read_by, reader_of, readers
from quadexp.plugins.logs.importers.readers.csv import ready_mappings
from quadexp.plugins.logs.importers.table import open_table
from quadexp.plugins.logs.signal import GAP_PERIODS, Stream, derivative, numbered
from quadexp.plugins.logs.signal.offset import aligned, find_offsets
from quadexp.plugins.logs.signal.resample import interpolate
from quadexp.plugins.logs.units import mounting_matrix
from quadexp.provenance import provenance, versions

MOST = 0.2  # share of the rows: beyond, the fault is not one of rows
ROUNDS = 3  # what is left out may have hidden something
ATTITUDES = (("q_w", "q_x", "q_y", "q_z"), ("ref_q_w", "ref_q_x", "ref_q_y", "ref_q_z"))
HELD = ("motor_command_", "u_", "battery_voltage", "wind_", "segment", "status")


@dataclass
class Options:
    """How to import. rate: Hz, None for the log's own. crop: whether to cut ground phases. align: whether to move the
    streams by the time offsets found. mounting, gyro_mounting: roll, pitch, yaw of the sensor in the body (deg).
    bad_rows: refuse, drop or gap, of rows that cannot be (repeated, outliers, filled in by a dead logger)."""

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
    known = ("auto", *ready(), *readers())
    if options.format not in known:
        raise UsageError(f"--log-format {options.format}: no such format; there are {', '.join(known)}")
    if options.mapping is None and options.format == "csv":
        raise UsageError("--log-format csv: needs --mapping FILE; `quadexp import --describe LOG` proposes one")
    if options.rate is not None and not 0.1 <= options.rate <= 10_000:
        raise UsageError(f"--rate {options.rate:g}: must be in [0.1, 10000] Hz")
    return None if options.mapping is None else load_mapping(options.mapping)


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
            return flight, said_once([*log.notes, *moved])
        flight, counts, left_out = without_bad_rows(flight, vehicle, options.bad_rows, derived=derived)
        if counts:
            flight.metadata["source"]["left_out"] = {"mode": options.bad_rows, "rows": counts}
        return flight, said_once([*log.notes, *moved, *left_out])


def said_once(notes: list[str]) -> list[str]:
    """Notes of several streams that say the same, as those of one clock do, as one."""
    streams: dict[str, list[str]] = {}
    for note in notes:
        name, colon, text = note.partition(": ")
        streams.setdefault(text if colon else note, []).append(name if colon else "")
    said = []
    for text, names in streams.items():
        if len(names) > 1:  # without the columns
            names = distinct(name.partition(" (")[0] for name in names)
        said.append(f"{', '.join(names)}: {text}" if names[0] else text)
    return said


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
    if form not in ("auto", kind) and not (kind == "csv" and form in ready()):
        raise DataError(f"{path}: its content is {kind}, not --log-format {form}")
    if mapping is None:
        return read_by(kind, path, form)
    if mapping.format == kind:
        log = read_by(kind, path, form)
        log.crop = mapping.crop
        for correction in mapping.corrections:
            log.streams = corrected(log.streams, correction)
        return log
    table = open_table(path) if kind == "csv" else None
    if table is None or mapping.format != table.format:
        kind = kind if table is None else table.format
        said = f"{path}: its content is {kind}, the mapping {mapping.name} is for {mapping.format}"
        raise DataError(f"{said}; its key is `format: {kind}`")
    return read_mapped(table, mapping)


def ready() -> list[str]:
    """Formats that are a ready mapping of tables."""
    return [mapping.name for mapping in ready_mappings()]


def _offsets(log: RawLog, align: bool) -> tuple[dict[str, Any], list[str]]:
    """For the record, and as notes. align: move the streams that are late, see `aligned`."""
    record = {}
    notes = []
    offsets = find_offsets(log.streams)
    if align:
        log.streams.update(aligned(log.streams, offsets))
    for (name, behind), offset in offsets.items():
        removed = align and offset.certain
        if offset.certain:
            moved = ", removed" if removed else ""
            notes.append(f"time offset: {name} {1e3 * offset.seconds:+.1f} ms behind {behind} {offset.words}{moved}")
        shown = without(offset._asdict(), ("rival", "middle"))
        if not np.isfinite(offset.error):
            shown["error"] = None
        record[name] = shown | {"behind": behind, "removed": removed}
    return record, notes


def _metadata(path: Path, log: RawLog, vehicle: Vehicle | None, offsets: dict[str, Any]) -> dict[str, Any]:
    source: dict[str, Any] = {"file": path.name, "sha256": digest(path), "format": log.format, "mapping": log.mapping}
    metadata = {
        "name": path.stem,
        "outcome": "ok",
        "recorded": True,
        "source": source | {"offsets": offsets} | log.about,
    }
    metadata |= {"versions": versions(), "provenance": provenance()}
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


# ------------------------------------------------------------------------------------------------------------ bad rows
def without_bad_rows(
    flight: Flight, vehicle: Vehicle | None, mode: str, *, derived: bool = False
) -> tuple[Flight, dict[str, int], list[str]]:
    """The flight without its bad samples; how many by the fault's name; and notes.

    mode: "drop": a run of fewer than GAP_PERIODS rows is bridged between its neighbours, as lost samples are; a longer
    one is a gap. "gap": every run is one. A gap starts a new segment. derived: whether the velocity is that of the
    position, and made anew.
    """
    inspect_flight = service("inspect_flight", f"--bad-rows {mode}")
    counts: dict[str, int] = {}
    total, length = 0, len(flight)
    for _ in range(ROUNDS):
        _, masks, _ = inspect_flight(flight, vehicle)
        bad = np.zeros(len(flight), bool)
        for mask in masks.values():
            bad |= mask
        if not bad.any():
            break
        if total + int(bad.sum()) > MOST * length:
            text = f"{bad.mean():.1%} of the rows are bad ({', '.join(masks)}), {MOST:.0%} is the most that is left out"
            return flight, counts, [f"{text}: not done"]
        for name, mask in masks.items():
            counts[name] = counts.get(name, 0) + int(mask.sum())
        total += int(bad.sum())
        flight = _without(flight, bad, mode, derived)
    if not total:
        return flight, counts, []
    by_name = ", ".join(f"{count} {name}" for name, count in counts.items())
    what = "bridged where short, else made a gap" if mode == "drop" else "made gaps"
    return flight, counts, [f"left out: {total} of {length} rows ({total / length:.2%}; {by_name}), {what}"]


def _without(flight: Flight, bad: np.ndarray, mode: str, derived: bool) -> Flight:
    bridged = np.zeros(len(flight), bool)
    for start, stop in runs(bad) if mode == "drop" else ():
        if stop - start < GAP_PERIODS and start > 0 and stop < len(bad):
            bridged[start:stop] = True
    segment = np.asarray(flight.columns.get("segment", np.zeros(len(flight))))
    kept = bridged | ~bad
    number = numbered(segment, kept)
    kept[kept] = np.bincount(number)[number] >= SHORTEST
    if kept.sum() < 2 * SHORTEST:
        raise DataError("nothing is left once bad rows are left out")
    columns = {name: values[kept] for name, values in _bridged(flight, bad, bridged).items()}
    columns["segment"] = numbered(segment, kept)
    columns["t"] = columns["t"] - columns["t"][0]
    shorter = Flight(columns, flight.metadata)
    if derived:
        window = max(0.1, 5 * period_of(shorter.t))
        position = shorter.stack(["p_x", "p_y", "p_z"])
        velocity = derivative(shorter.t, position, segment=shorter["segment"], window=window)
        columns |= named(("v_x", "v_y", "v_z"), velocity.values.T)
    return shorter


def _bridged(flight: Flight, bad: np.ndarray, filled: np.ndarray) -> dict[str, np.ndarray]:
    """The columns with the rows `filled` made from rows that are not bad."""
    columns = dict(flight.columns)
    if not filled.any():
        return columns
    together = [names for names in ATTITUDES if set(names) <= columns.keys()]
    alone = [(name,) for name in without(columns, {"t", *chain(*together)})]
    for names in (*together, *alone):
        values = flight.stack(names)
        if values.dtype.kind not in "fiu":
            continue
        held = names[0].startswith(HELD) or values.dtype.kind != "f"
        good = values[~bad].astype(float)
        values[filled] = interpolate(flight.t[~bad], good, flight.t[filled], sphere=names in ATTITUDES, held=held)
        columns |= named(names, values.T)
    return columns
