"""Poses as TUM text, `t x y z qx qy qz qw` (s, m, world ENU; quaternion body to world, w last).

The pose flown goes to the path given and the reference beside it, so that a trajectory tool can compare them:

    evo_ape tum flight_reference.tum flight.tum
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from quadexp.files.writer import check_output, write_text
from quadexp.log.schema import Flight

POSE = ("p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w")


def write(flight: Flight, path: Path, *, force: bool = True) -> dict[str, Path]:
    """Write `path` and `<stem>_reference<suffix>`; returns name -> file."""
    files, poses = {"tum": path}, {"tum": flight.stack(POSE)}
    wanted = [f"ref_{name}" for name in POSE]
    if all(name in flight.columns for name in wanted):
        files["reference"] = check_output(path.with_name(f"{path.stem}_reference{path.suffix}"), force=force)
        poses["reference"] = flight.stack(wanted)
    return {name: write_text(files[name], _text(flight.t, pose), force=force) for name, pose in poses.items()}


def _text(t: np.ndarray, pose: np.ndarray) -> str:
    lines = [" ".join(map(repr, row)) for row in np.column_stack([t, pose]).tolist()]
    return "\n".join(["# t x y z qx qy qz qw", *lines]) + "\n"
