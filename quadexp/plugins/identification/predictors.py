"""What predicts the specific force of a flight: a thrust curve and an acceleration beyond it.

    f_model = (0, 0, sum_i a_i) + a(v, w, a_1 .. a_n)        body FLU, m/s^2

An identified vehicle gives a predictor for each of its models, every other checkpoint one, and "nominal" is the curve
alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.models.base import Model
from quadexp.models.checkpoint import record_of
from quadexp.models.dataset import feature_rows
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.terms import TermModel
from quadexp.plugins.identification.thrust_curve import ThrustCurve
from quadexp.plugins.identification.vehicle_model import VehicleModel

NOMINAL = "nominal"
_KIND_NAMES = {"linear": "linear drag", "quadratic": "quadratic drag", "blade_element": "blade element"}
Acceleration = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Predictor:
    """name: in tables. curve: thrust. beyond: (v (k, 3), w (k, 3), rotor accelerations (k, n)) -> (k, 3), m/s^2.

    seen: names of the flights of the fit. ranges: of the fit, see quadexp.models.base. mass: kg, to convert rotor
    accelerations to the thrusts in the ranges.
    """

    name: str
    curve: ThrustCurve
    beyond: Acceleration
    seen: tuple[str, ...] = ()
    ranges: dict[str, Any] = field(default_factory=dict)
    mass: float = 1.0


def nominal(curve: ThrustCurve, seen: tuple[str, ...] = ()) -> Predictor:
    """The thrust curve only."""
    return Predictor(NOMINAL, curve, lambda v, w, a: np.zeros((len(v), 3)), seen)


def predictors(model: Model, label: str, vehicle: Vehicle, curve: ThrustCurve | None) -> list[Predictor]:
    """The predictors of a checkpoint: the models of an identified vehicle, of every other one itself.

    label: name of a model without a thrust curve of its own. curve: for it. Raises UsageError where there is none.
    """
    seen = tuple(model.dataset.get("names", ()))
    if isinstance(model, VehicleModel):
        of_model = [nominal(model.thrust, seen)]
        for kind, terms in model.models.items():
            of_model.append(Predictor(_KIND_NAMES[kind], model.thrust, _beyond(terms), seen, model.feature_range))
        return of_model
    record = model.dataset.get("thrust")
    if record:
        curve = record_of(record, ThrustCurve)
    if curve is None:
        raise UsageError(f"{label}: was not fitted to recorded flights; also give an identified vehicle (a folder of"
                         " `quadexp identify`) for its thrust curve")  # fmt: skip

    def beyond(v: np.ndarray, w: np.ndarray, a: np.ndarray) -> np.ndarray:
        return model.acceleration(feature_rows(v, w, vehicle.mass * a))

    return [Predictor(label, curve, beyond, seen, model.feature_range, vehicle.mass)]


def _beyond(terms: TermModel) -> Acceleration:
    return lambda v, w, a: terms.acceleration(v, a)
