"""What differs between flights and no model of velocity can know: the scale of the thrust.

    a_z = e_f T / m + what the air does           e_f: of one flight; T / m: the thrust curve's acceleration, m/s^2

A used battery, another propeller or a warmer motor gives a few per cent more or less thrust for the same command. A
regression on several flights takes that for an effect of whatever differs between them (speed, mean thrust) and is then
wrong on the next one. So what is fitted to recorded flights is fitted to rows without their flights' deviations from
the mean e_f, and the spread of e_f over the flights goes into the predicted variance. On the next flight e is unknown
at take-off and can be tracked (quadexp.learn.tracking).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadexp.learn.dataset import THRUST, ResidualDataset


class Trim(NamedTuple):
    """dataset: rows with one scale error on all flights. errors: e_f by flight number. level: mean T / m, m/s^2."""

    dataset: ResidualDataset
    errors: dict[int, float]
    level: float

    @property
    def variance(self) -> float:
        """Of a_z on a flight not seen, by the spread of e_f, (m/s^2)^2; 0 where one flight says nothing of it."""
        values = list(self.errors.values())
        return float(np.var(values, ddof=1)) * self.level**2 if len(values) > 1 else 0.0


def trim(dataset: ResidualDataset) -> Trim:
    """Bring e_f, the least-squares scale of a_z on the thrust, to one value on all flights of recorded rows."""
    mass = dataset.metadata["vehicle"]["mass"]
    acceleration = dataset.matrix([THRUST])[:, 0] / mass
    a_z = dataset.matrix(["a_z"])[:, 0].copy()
    flight = np.asarray(dataset.columns["flight"])
    errors = {}
    for index in np.unique(flight):
        own = flight == index
        errors[int(index)] = float(acceleration[own] @ a_z[own] / (acceleration[own] @ acceleration[own]))
    middle = float(np.mean(list(errors.values())))  # one flight alone has nothing to differ from
    for index, error in errors.items():
        own = flight == index
        a_z[own] -= (error - middle) * acceleration[own]
    columns = dict(dataset.columns) | {"a_z": a_z}
    return Trim(ResidualDataset(columns, dataset.metadata), errors, float(acceleration.mean()))


def is_trimmable(dataset: ResidualDataset) -> bool:
    """Whether the rows are of recorded flights under a thrust curve."""
    return bool(dataset.metadata.get("recorded")) and "mass" in (dataset.metadata.get("vehicle") or {})
