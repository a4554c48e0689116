"""A dataset without the part that a fitted model explains, for a fit of the rest."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.learn.dataset import ResidualDataset
from quadexp.learn.linear_drag import LinearDrag
from quadexp.learn.model import GPModel
from quadexp.learn.neural import NeuralModel
from quadexp.learn.predict import predict
from quadexp.learn.thrust_scale import has_thrust_scale


def without(data: ResidualDataset, model: Any, label: str) -> ResidualDataset:
    """The dataset with the model's predictions subtracted from its outputs; label: of the model, for the record.

    Raises UsageError for an identified vehicle, and for recorded flights, whose thrust scale is fitted with the model.
    """
    if has_thrust_scale(data):
        raise UsageError("--after: only of simulated flights; recorded ones have a thrust scale that is fitted too")
    found: Mapping[str, np.ndarray]
    if isinstance(model, GPModel):
        found = {output: one.mean for output, one in predict(model, data).items()}
    elif isinstance(model, LinearDrag):
        found = dict(zip(("a_x", "a_y", "a_z"), model.acceleration(data).T, strict=True))
    elif isinstance(model, NeuralModel):
        found = model.predict(data)
    else:
        raise UsageError(f"{label}: an identified vehicle; --after needs a checkpoint of fit-drag, fit-gp or fit-nn")
    columns = dict(data.columns) | {output: data.matrix([output])[:, 0] - mean for output, mean in found.items()}
    return ResidualDataset(columns, dict(data.metadata) | {"after": label})
