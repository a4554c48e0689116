"""Flights in other programs' formats: one function a format, `write(flight, path, force=...)`, says what it wrote."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from quadexp.errors import UsageError
from quadexp.log.store import read_flight
from quadexp.writer import check_output

FORMATS = {  # suffix of the file, module and function that write it
    "csv": (".csv", "text", "write_columns"),  # every column, with units and the record beside it as JSON
    "tum": (".tum", "text", "write_poses"),  # poses flown and wanted, for evo and other trajectory tools
    "mcap": (".mcap", "mcap_file", "write"),  # poses, transforms and every column, for Foxglove
    "rerun": (".rrd", "rerun_file", "write"),  # a recording for the Rerun viewer
}
_TRACKERS = "went: log the rows of results.csv, or of qx.load(FOLDER), from Python"
GONE = {
    "px4csv": "went: --to csv has every column with unit and frame; NED and FRD are (y, x, -z) and (x, -y, -z)",
    "mlflow": _TRACKERS,
    "wandb": _TRACKERS,
}


def export_flight(
    flight: str | Path, form: str, out: str | Path | None = None, *, force: bool = False
) -> dict[str, Path]:
    """Write a flight file in another format; returns name -> file.

    out: file; beside the flight unless given.
    Raises UsageError for an unknown format, an extra that is not installed, or a path that cannot be written.
    """
    if form in GONE:
        raise UsageError(f"--to {form}: {GONE[form]}")
    if form not in FORMATS:
        raise UsageError(f"--to {form}: no such format; there are {', '.join(FORMATS)}")
    suffix, module, function = FORMATS[form]
    source = Path(flight)
    target = Path(out) if out is not None else source.with_suffix(suffix)
    loaded = read_flight(source)
    if not len(loaded):
        raise UsageError(f"{source}: holds no samples ({loaded.outcome}), there is nothing to export")
    check_output(target, force=force)
    write: Callable[..., dict[str, Path]] = getattr(import_module(f"{__name__}.{module}"), function)
    return write(loaded, target, force=force)
