"""A flight as one CSV of all its columns, and a JSON beside it with their units, frames and the flight's record.

Numbers stand in the shortest digits that give the same double back, so nothing is lost.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow.csv import WriteOptions, write_csv

from quadexp.files.writer import check_output, write_text, written
from quadexp.log.schema import Flight, describe
from quadexp.messages import csv_line


def write(flight: Flight, path: Path, *, force: bool = True) -> dict[str, Path]:
    """Write `path` and `<path>.json`; returns name -> file."""
    about = {"columns": {name: describe(name)._asdict() for name in flight.columns}, "record": flight.metadata}
    beside = check_output(path.with_name(f"{path.name}.json"), force=force)
    return {
        "csv": write_columns(path, flight.columns, force=force),
        "about": write_text(beside, json.dumps(about, indent=1, sort_keys=True) + "\n", force=force),
    }


def write_columns(path: Path, columns: Mapping[str, Any], *, force: bool = True) -> Path:
    """Columns (each (k,)) as a CSV with one line of names; NaN is an empty cell."""
    table = pa.table([pa.array(np.asarray(values), from_pandas=True) for values in columns.values()], [*columns])
    with written(path, force=force) as file:
        file.write(f"{csv_line(columns)}\n".encode())
        write_csv(table, file, WriteOptions(include_header=False, quoting_style="none"))  # in blocks
    return path
