"""Poses as TUM text, `t x y z qx qy qz qw` (s, m, world ENU; quaternion body to world, w last).

The pose flown goes to the path given and the reference beside it, so that a trajectory tool can compare them:

    evo_ape tum flight_reference.tum flight.tum
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from quadexp.log.schema import Flight
from quadexp.log.store import write_text

POSE = ("p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w")


def write(flight: Flight, path: Path) -> dict[str, Path]:
    """Write `path` and `<stem>_reference<suffix>`; returns name -> file."""
    files = {"tum": _write(path, flight.t, flight.stack(POSE))}
    wanted = [f"ref_{name}" for name in POSE]
    if all(name in flight.columns for name in wanted):
        reference = path.with_name(f"{path.stem}_reference{path.suffix}")
        files["reference"] = _write(reference, flight.t, flight.stack(wanted))
    return files


def _write(path: Path, t: np.ndarray, pose: np.ndarray) -> Path:
    lines = [" ".join(map(repr, row)) for row in np.column_stack([t, pose]).tolist()]
    return write_text(path, "\n".join(["# t x y z qx qy qz qw", *lines]) + "\n")
