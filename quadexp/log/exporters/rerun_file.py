"""A flight as a recording for the Rerun viewer (.rrd), over the timeline `t`.

world/drone            pose flown (Transform3D, world ENU, body FLU)
world/flown, world/reference   the whole paths
error                  distance to the reference (m)
columns/<name>         every column of the flight, as a double
record                 the flight's record, as JSON text
"""

from __future__ import annotations

import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError, missing_package
from quadexp.log.schema import Flight
from quadexp.writer import written

TIMELINE = "t"
BLUE, GREY = (0, 114, 178), (136, 136, 136)


def write(flight: Flight, path: Path, *, force: bool = True) -> dict[str, Path]:
    """Write the recording; UsageError where the package is missing."""
    try:
        import rerun
    except ImportError:
        raise missing_package("--to rerun", "rerun-sdk", "viz") from None
    try:
        with written(path, force=force) as file, tempfile.TemporaryDirectory() as folder:  # rerun takes a path only
            _write(flight, stored := Path(folder) / "flight.rrd", rerun)
            with open(stored, "rb") as source:
                shutil.copyfileobj(source, file)
        return {"rerun": path}
    except RuntimeError as error:  # its writer thread died: what is said above by rerun itself
        raise QuadexpError(f"{path}: cannot be written ({error})") from None


def _write(flight: Flight, path: Path, rr: Any) -> None:
    with rr.RecordingStream("quadexp", send_properties=False) as stream:
        stream.save(str(path))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        flown = flight.stack(["p_x", "p_y", "p_z"])
        stream.log("world/flown", rr.LineStrips3D([flown], colors=[BLUE]), static=True)
        stream.log("record", rr.TextDocument(json.dumps(flight.metadata, indent=1, sort_keys=True)), static=True)
        index = [rr.TimeColumn(TIMELINE, duration=flight.t)]
        quaternion = flight.stack(["q_x", "q_y", "q_z", "q_w"])
        stream.send_columns("world/drone", index, rr.Transform3D.columns(translation=flown, quaternion=quaternion))
        arm = _arm(flight)
        body = [[[arm, 0, 0], [-arm, 0, 0]], [[0, arm, 0], [0, -arm, 0]], [[0, 0, 0], [0, 0, arm]]]
        stream.log("world/drone/body", rr.LineStrips3D(body, colors=[BLUE]), static=True)
        if "ref_p_x" in flight.columns:
            wanted = flight.stack(["ref_p_x", "ref_p_y", "ref_p_z"])
            stream.log("world/reference", rr.LineStrips3D([wanted], colors=[GREY]), static=True)
            error = np.linalg.norm(flown - wanted, axis=1)
            stream.send_columns("error", index, rr.Scalars.columns(scalars=error))
        for name, values in flight.columns.items():
            stream.send_columns(f"columns/{name}", index, rr.Scalars.columns(scalars=values.astype(float)))


def _arm(flight: Flight) -> float:
    """Length of the longest arm, m; a quarter of a metre where the record does not say."""
    rotors = flight.metadata.get("config", {}).get("vehicle", {}).get("rotor_position")
    return float(np.linalg.norm(rotors, axis=1).max()) if rotors else 0.25
