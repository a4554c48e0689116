"""Where a model has data: the ranges of its features over the rows of the fit, and which other samples lie outside.

A sample is outside where any of these is below the least or above the largest value of the rows:

    v_x, v_y, v_z       body velocity relative to the air, m/s
    speed               its norm, m/s
    every other feature of the model: thrust (N), body rates (rad/s), rotor thrusts (N)

Each is looked at by itself. What is not measured: combinations that the rows do not have (full thrust at full speed),
gaps inside a range, and what is no feature. Inside therefore means "no range is left", not "the model holds".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from quadexp.learn.dataset import ResidualDataset

VELOCITY = ("v_x", "v_y", "v_z")
SPEED = "speed"
WORTH_SAYING = 0.01  # share of samples outside from which on a flight says so
Ranges = Mapping[str, Sequence[float]]


def feature_values(dataset: ResidualDataset, name: str) -> np.ndarray:
    """A feature of the rows, or their speed, (k,)."""
    if name == SPEED:
        return np.linalg.norm(dataset.matrix(VELOCITY), axis=1)
    return dataset.matrix([name])[:, 0]


def feature_ranges(dataset: ResidualDataset, features: Sequence[str] = ()) -> dict[str, list[float]]:
    """[least, largest] of body velocity, speed and the features named, over all rows."""
    found = {}
    for name in dict.fromkeys([*VELOCITY, SPEED, *features]):
        values = feature_values(dataset, name)
        found[name] = [0.0 if name == SPEED else float(values.min()), float(values.max())]
    return found


def outside(ranges: Ranges, dataset: ResidualDataset) -> dict[str, np.ndarray]:
    """Which rows are outside each range, name -> (k,)."""
    found = {}
    for name, (low, high) in ranges.items():
        values = feature_values(dataset, name)
        found[name] = (values < low) | (values > high)
    return found


def outside_shares(ranges: Ranges, dataset: ResidualDataset) -> dict[str, float]:
    """Share of the rows outside each range, and outside "any"."""
    found = outside(ranges, dataset)
    anywhere = np.logical_or.reduce(list(found.values()))
    return {name: float(mask.mean()) for name, mask in found.items()} | {"any": float(anywhere.mean())}
