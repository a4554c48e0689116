"""One scale of the thrust for all flights of a data set."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadexp.models.dataset import ResidualDataset
from quadexp.plugin import service


class CommonScale(NamedTuple):
    """dataset: rows with one thrust scale on all flights. errors: e_f by flight index. level: mean T / m, m/s^2."""

    dataset: ResidualDataset
    errors: dict[int, float]
    level: float

    @property
    def variance(self) -> float:
        """Variance of a_z on a new flight due to the spread of e_f, (m/s^2)^2; 0 with one flight."""
        values = list(self.errors.values())
        if len(values) < 2:
            return 0.0
        return float(np.var(values, ddof=1)) * self.level**2


def has_thrust_scale(dataset: ResidualDataset) -> bool:
    """Whether the rows come from recorded flights under a thrust curve, whose scale may differ between flights."""
    return bool(dataset.metadata.get("recorded")) and "mass" in (dataset.metadata.get("vehicle") or {})


def with_common_scale(dataset: ResidualDataset) -> CommonScale:
    """Bring e_f to its mean over the flights, where these have one, by the service of that name."""
    if not has_thrust_scale(dataset):
        return CommonScale(dataset, {}, 0.0)
    scaled: CommonScale = service("common_scale", "fit")(dataset)
    return scaled
