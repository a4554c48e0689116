"""A flight as text: one CSV of all its columns with a JSON beside it, or its poses as TUM.

CSV: the JSON has units, frames and the flight's record. Numbers stand in the shortest digits that give the same double
back, so nothing is lost.

TUM: `t x y z qx qy qz qw` (s, m, world ENU; quaternion body to world, w last). The pose flown goes to the path given
and the reference beside it, so that a trajectory tool can compare them: `evo_ape tum flight_reference.tum flight.tum`.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow.csv import WriteOptions, write_csv

from quadexp.log.schema import Flight, describe
from quadexp.messages import csv_line
from quadexp.writer import check_output, write_text, written

POSE = ("p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w")


def write_columns(flight: Flight, path: Path, *, force: bool = True) -> dict[str, Path]:
    """Write `path` and `<path>.json`; NaN is an empty cell. Returns name -> file."""
    about = {"columns": {name: describe(name)._asdict() for name in flight.columns}, "record": flight.metadata}
    beside = check_output(path.with_name(f"{path.name}.json"), force=force)
    table = pa.table([pa.array(np.asarray(x), from_pandas=True) for x in flight.columns.values()], [*flight.columns])
    with written(path, force=force) as file:
        file.write(f"{csv_line(flight.columns)}\n".encode())
        write_csv(table, file, WriteOptions(include_header=False, quoting_style="none"))  # in blocks
    return {"csv": path, "about": write_text(beside, json.dumps(about, indent=1, sort_keys=True) + "\n", force=force)}


def write_poses(flight: Flight, path: Path, *, force: bool = True) -> dict[str, Path]:
    """Write `path` and `<stem>_reference<suffix>`; returns name -> file."""
    files, poses = {"tum": path}, {"tum": flight.stack(POSE)}
    wanted = [f"ref_{name}" for name in POSE]
    if all(name in flight.columns for name in wanted):
        files["reference"] = check_output(path.with_name(f"{path.stem}_reference{path.suffix}"), force=force)
        poses["reference"] = flight.stack(wanted)
    return {name: write_text(files[name], _tum(flight.t, pose), force=force) for name, pose in poses.items()}


def _tum(t: np.ndarray, pose: np.ndarray) -> str:
    lines = [" ".join(map(repr, row)) for row in np.column_stack([t, pose]).tolist()]
    return "\n".join(["# t x y z qx qy qz qw", *lines]) + "\n"
