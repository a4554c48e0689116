"""Flights in other programs' formats: one function a format, `write(flight, path, force=...)`, says what it wrote."""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError, UsageError, missing_package
from quadexp.log.schema import Flight, describe
from quadexp.log.store import read_flight
from quadexp.messages import csv_line
from quadexp.physics.state import norms
from quadexp.writer import check_output, write_text, written

POSE = ("p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w")
BLUE = (0, 114, 178)  # 8-bit RGB, of Okabe and Ito
GREY = (136, 136, 136)  # 8-bit RGB


def write_columns(flight: Flight, path: Path, *, force: bool) -> dict[str, Path]:
    """One CSV of all columns, and `<path>.json` with units, frames and the flight's record; returns name -> file.

    Numbers stand in the shortest digits that give the same double back, so nothing is lost; NaN is an empty cell.
    """
    import pyarrow as pa
    from pyarrow.csv import WriteOptions, write_csv

    described = {name: describe(name)._asdict() for name in flight.columns}
    about = json.dumps({"columns": described, "record": flight.metadata}, indent=1, sort_keys=True)
    beside = check_output(path.with_name(f"{path.name}.json"), force=force)
    columns = {name: pa.array(np.asarray(x), from_pandas=True) for name, x in flight.columns.items()}
    table = pa.table(columns)
    with written(path, force=force) as file:
        file.write(f"{csv_line(flight.columns)}\n".encode())
        write_csv(table, file, WriteOptions(include_header=False, quoting_style="none"))  # in blocks
    return {"csv": path, "about": write_text(beside, f"{about}\n", force=force)}


def write_poses(flight: Flight, path: Path, *, force: bool) -> dict[str, Path]:
    """TUM, `t x y z qx qy qz qw` (s, m, world ENU; body to world, w last), and the reference as
    `<stem>_reference<suffix>`: `evo_ape tum flight_reference.tum flight.tum` compares them. Returns name -> file."""
    files = {"tum": path}
    poses = {"tum": flight.stack(POSE)}
    wanted = [f"ref_{name}" for name in POSE]
    if set(wanted) <= set(flight.columns):
        files["reference"] = check_output(path.with_name(f"{path.stem}_reference{path.suffix}"), force=force)
        poses["reference"] = flight.stack(wanted)
    for name, pose in poses.items():
        lines = ["# t x y z qx qy qz qw"]
        for row in np.column_stack([flight.t, pose]).tolist():
            lines.append(" ".join(map(repr, row)))
        text = "\n".join(lines)
        write_text(files[name], f"{text}\n", force=force)
    return files


def write_recording(flight: Flight, path: Path, *, force: bool) -> dict[str, Path]:
    """A recording for the Rerun viewer over the timeline `t`: world/drone, world/flown and world/reference (ENU), the
    distance to the reference (m), every column under columns/, the record as text.

    Returns name -> file. Raises UsageError where the package is missing.
    """
    try:
        import rerun
    except ImportError:
        raise missing_package("--to rerun", "rerun-sdk", "viz") from None
    try:
        with written(path, force=force) as file, tempfile.TemporaryDirectory() as folder:  # rerun takes a path only
            stored = Path(folder) / "flight.rrd"
            _record(flight, stored, rerun)
            with open(stored, "rb") as source:
                shutil.copyfileobj(source, file)
    except RuntimeError as error:  # its writer thread died: what is said above by rerun itself
        raise QuadexpError(f"{path}: cannot be written ({error})") from None
    return {"rerun": path}


def _record(flight: Flight, path: Path, rr: Any) -> None:
    with rr.RecordingStream("quadexp", send_properties=False) as stream:
        stream.save(str(path))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        flown = flight.stack(POSE[:3])
        stream.log("world/flown", rr.LineStrips3D([flown], colors=[BLUE]), static=True)
        stream.log("record", rr.TextDocument(json.dumps(flight.metadata, indent=1, sort_keys=True)), static=True)
        index = [rr.TimeColumn("t", duration=flight.t)]
        poses = rr.Transform3D.columns(translation=flown, quaternion=flight.stack(POSE[3:]))
        stream.send_columns("world/drone", index, poses)
        arm = float(norms(flight.rotor_position).max())  # m
        body = [[[arm, 0, 0], [-arm, 0, 0]], [[0, arm, 0], [0, -arm, 0]], [[0, 0, 0], [0, 0, arm]]]
        stream.log("world/drone/body", rr.LineStrips3D(body, colors=[BLUE]), static=True)
        if "ref_p_x" in flight.columns:
            wanted = flight.stack([f"ref_{name}" for name in POSE[:3]])
            stream.log("world/reference", rr.LineStrips3D([wanted], colors=[GREY]), static=True)
            error = norms(flown - wanted)
            stream.send_columns("error", index, rr.Scalars.columns(scalars=error))
        for name, values in flight.columns.items():
            stream.send_columns(f"columns/{name}", index, rr.Scalars.columns(scalars=values.astype(float)))


FORMATS = {  # suffix of the file, and what writes it
    "csv": (".csv", write_columns),
    "tum": (".tum", write_poses),
    "rerun": (".rrd", write_recording),
}


def export_flight(
    flight: str | Path, form: str, out: str | Path | None = None, *, force: bool = False
) -> dict[str, Path]:
    """Write a flight file in another format; returns name -> file.

    out: file; beside the flight unless given.
    Raises UsageError for an unknown format, an extra that is not installed, or a path that cannot be written.
    """
    if form not in FORMATS:
        raise UsageError(f"--to {form}: no such format; there are {', '.join(FORMATS)}")
    suffix, write = FORMATS[form]
    source = Path(flight)
    loaded = read_flight(flight)
    target = source.with_suffix(suffix)
    if out is not None:
        target = Path(out)
    if not len(loaded):
        raise UsageError(f"{source}: holds no samples ({loaded.outcome}), there is nothing to export")
    check_output(target, force=force)
    return write(loaded, target, force=force)
