"""A flight as one CSV of all its columns, and a JSON beside it with their units, frames and the flight's record.

Numbers stand in the shortest digits that give the same double back, so nothing is lost.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.files.writer import check_output, write_text
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
    texts = [_texts(np.asarray(values)) for values in columns.values()]
    lines = [csv_line(columns), *(",".join(row) for row in zip(*texts, strict=True))]
    return write_text(path, "\n".join(lines) + "\n", force=force)


def _texts(values: np.ndarray) -> list[str]:
    return ["" if value != value else repr(value) for value in values.tolist()]
