"""How much of a flight lay outside the data that the controller's learned model was fitted to."""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.experiment.identity import ModelFile
from quadexp.log.schema import Flight

UNKNOWN = "the checkpoint has no ranges of its data (fitted by an older version); fit it again"


def outside_data(flight: Flight, model: ModelFile | None, controller: Any) -> dict[str, Any] | None:
    """{model, share, shares, ranges, note} of a flight, None where the controller flies without a learned model.

    share: of the samples, 0..1, None where it is unknown. shares: of every feature. See quadexp.models.base.
    """
    if model is None:
        return None
    from quadexp.control.observers.observer import air_of
    from quadexp.control.wrapped import innermost

    ranges = dict(air_of(innermost(controller)).ranges or {})
    record: dict[str, Any] = {"model": model.path, "share": None, "shares": {}, "ranges": ranges, "note": UNKNOWN}
    if not ranges or not len(flight):
        return record | ({"note": "the flight has no samples"} if ranges else {})
    from quadexp.models.base import outside_shares
    from quadexp.models.dataset import feature_rows

    rate = flight.stack(["w_x", "w_y", "w_z"])
    finite = np.isfinite(flight.state).all(axis=1)
    features = feature_rows(flight.air_velocity[finite], rate[finite], flight.input[finite])
    shares = outside_shares(ranges, features)
    return record | {"share": shares.pop("any"), "shares": shares, "note": ""}
