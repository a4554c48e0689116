"""What an identification of a vehicle found: the model, the samples, and the estimates as they came in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.learn.recursion import Recursion
from quadexp.learn.samples import Samples
from quadexp.learn.vehicle_model import VehicleModel


@dataclass(frozen=True)
class VehicleIdentification:
    """What was found. series: model kind -> axis -> recursion; samples: what they run over. report: JSON-able."""

    model: VehicleModel
    samples: Samples
    series: dict[str, dict[str, Recursion]]
    report: dict[str, Any]

    def columns(self) -> dict[str, np.ndarray]:
        """The series of estimates as named columns, `<model>_<term>_<axis>` and `std_...` beside it."""
        first = next(iter(next(iter(self.series.values())).values()))
        columns = {"t": elapsed(self.samples)[first.row], "flight": self.samples.flight[first.row].astype(np.int32)}
        for kind, axes in self.series.items():
            for recursion in axes.values():
                for j, name in enumerate(recursion.names):
                    columns[f"{kind}_{name}"] = recursion.coefficients[:, j].copy()
                    columns[f"std_{kind}_{name}"] = recursion.errors[:, j].copy()
        return columns


def elapsed(samples: Samples) -> np.ndarray:
    """Time over all flights, one put behind the other, (k,) (s)."""
    step = np.diff(samples.time, prepend=samples.time[0])
    usual = float(np.median(step[1:]))
    step[np.r_[True, samples.segment[1:] != samples.segment[:-1]]] = usual
    return np.cumsum(step) - usual
