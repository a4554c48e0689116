"""The position error of a flight as a log of the controller's side has it: our reading of the published metric.

Printed is an RMSE of position, not of which position. With poses 10 ms old the printed error is that without delay,
which the true position cannot give to a controller without prediction: at 12 m/s it is .12 m further. So the position
is taken to be the one that the controller was told, of age d, recorded after a call of the software at 300 Hz: that is
two steps of a simulation at 500 Hz, T, after the instant of the reference and the command that are recorded with it:

    e(t) = p(t + T - d) - p_r(t),     T = 2/500 s
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.log.cell_store import CellStore
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.parts.settings import declared
from quadexp.physics.state import POSITION
from quadexp.reference.ellipse import Ellipse

RECORDED_AFTER = 2 / 500  # s: the first instant of their simulation not before the end of a period of 1/300 s


def logged_rmse(flight: Flight) -> float:
    """RMSE (m) of an ellipse's flight, of the samples that it has; NaN without samples."""
    if not len(flight):
        return float("nan")
    config = flight.metadata["config"]
    given = {name: value for name, value in config["trajectory"].items() if name in declared(Ellipse)}
    late = config.get("estimator", {}).get("delay", 0.0)
    t = np.maximum(flight.t + late - RECORDED_AFTER, 0.0)  # of the reference with which this position is recorded
    wanted = Ellipse(**given).flat_output(t).position[:, 0]
    error = flight.state[:, POSITION] - wanted
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def with_logged(rows: Iterable[Mapping[str, Any]], out: str | Path) -> list[dict[str, Any]]:
    """Rows of a sweep with `rmse_logged` (m), from the flights of its folder; NaN where a flight is not there."""
    store = CellStore(out)

    def one(row: Mapping[str, Any]) -> float:
        path = store.path(row["key"])
        return logged_rmse(read_flight(path, check=False)) if path.is_file() else float("nan")

    return [{**row, "rmse_logged": one(row)} for row in rows]
