"""Range of the data that a model was fitted to, and which samples are outside it.

A sample is outside where any of these is below the least or above the largest value in the rows of the fit:

    v_x, v_y, v_z       body velocity relative to the air, m/s
    speed               its norm, m/s
    every other feature of the model: thrust (N), body rates (rad/s), rotor thrusts (N)

Each feature is checked separately. Not detected are combinations that the rows do not contain (full thrust at full
speed), gaps inside a range, and quantities that are not features. A sample inside all ranges may still be extrapolated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.models.dataset import ResidualDataset
from quadexp.models.residual import VELOCITY

SPEED = "speed"
REPORTED_SHARE = 0.01  # least share of samples outside that is reported for a flight
Ranges = Mapping[str, Sequence[float]]


def feature_values(dataset: ResidualDataset, name: str) -> np.ndarray:
    """Values of a feature, or of the speed, (k,)."""
    if name == SPEED:
        return np.linalg.norm(dataset.matrix(VELOCITY), axis=1)
    return dataset.matrix([name])[:, 0]


def feature_ranges(dataset: ResidualDataset, features: Sequence[str] = ()) -> dict[str, list[float]]:
    """[least, largest] of body velocity, speed and the features named, over all rows."""
    ranges = {}
    for name in dict.fromkeys([*VELOCITY, SPEED, *features]):
        values = feature_values(dataset, name)
        ranges[name] = [0.0 if name == SPEED else float(values.min()), float(values.max())]
    return ranges


def outside(ranges: Ranges, dataset: ResidualDataset) -> dict[str, np.ndarray]:
    """Which rows are outside each range, name -> (k,) bool."""
    masks = {}
    for name, (low, high) in ranges.items():
        values = feature_values(dataset, name)
        masks[name] = (values < low) | (values > high)
    return masks


def outside_shares(ranges: Ranges, dataset: ResidualDataset) -> dict[str, float]:
    """Share of the rows outside each range, and outside "any" of them."""
    masks = outside(ranges, dataset)
    anywhere = np.logical_or.reduce(list(masks.values()))
    return {name: float(mask.mean()) for name, mask in masks.items()} | {"any": float(anywhere.mean())}


def origin(dataset: ResidualDataset, features: Sequence[str] = ()) -> dict[str, Any]:
    """What a model's record says of the rows of its fit: vehicle, dataset and feature_range."""
    vehicle = dict(dataset.metadata.get("vehicle") or {})
    return {"vehicle": vehicle, "dataset": dataset.summary(), "feature_range": feature_ranges(dataset, features)}


def library_versions(*libraries: str) -> dict[str, str]:
    """Library -> version, for a model's record."""
    return {library: version(library) for library in libraries}


def require_variation(dataset: ResidualDataset, names: Sequence[str], features: int, key: str) -> None:
    """Raise DataError unless the rows have the columns named, of which so many are features that vary.

    key: of the configuration, for the message.
    """
    if not dataset.n_rows:
        raise DataError("dataset: it has no rows")
    for name, spread in zip(names[:features], dataset.matrix(names).std(axis=0), strict=False):
        if spread < 1e-9:
            raise DataError(f"{key}: '{name}' never changes over the {dataset.n_rows} rows; leave it out")
