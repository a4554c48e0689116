"""Everything that predicts a flight's specific force, in one form: a thrust curve and an acceleration beyond it.

    f = (0, 0, sum_i a_i) + a(v, w, a_1 .. a_n)          body FLU, m/s^2

nominal: nothing beyond the curve. An identified vehicle gives one for each of its models, a GP itself and the drag that
was fitted to the same rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.learn.dataset import feature_rows
from quadexp.learn.linear_drag import LinearDrag
from quadexp.learn.model import GPModel
from quadexp.learn.predict import predict
from quadexp.learn.recorded import curve_from_record
from quadexp.learn.thrust_curve import ThrustCurve
from quadexp.learn.torque import TorqueModel
from quadexp.learn.vehicle_model import VehicleModel
from quadexp.physics.vehicle import Vehicle

NOMINAL = "nominal"
Acceleration = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Predictor:
    """name: of the row. curve: thrust. beyond: (v (k, 3), w (k, 3), rotor accelerations (k, n)) -> (k, 3), m/s^2.

    seen: names of the flights that it was fitted to. ranges: of the fit, see quadexp.learn.support. mass: kg, of the
    vehicle whose thrust is in the ranges. torque: fitted, None where there is none.
    """

    name: str
    curve: ThrustCurve
    beyond: Acceleration
    seen: tuple[str, ...] = ()
    ranges: dict[str, Any] = field(default_factory=dict)
    mass: float = 1.0
    torque: TorqueModel | None = None


def nominal(curve: ThrustCurve, seen: tuple[str, ...] = (), torque: TorqueModel | None = None) -> Predictor:
    """The thrust curve alone."""
    return Predictor(NOMINAL, curve, lambda v, w, a: np.zeros((len(v), 3)), seen, torque=torque)


def predictors(model: Any, label: str, vehicle: Vehicle, curve: ThrustCurve | None) -> list[Predictor]:
    """What a checkpoint predicts with. label: of a GP or a drag fit. curve: of models that have none of their own.

    Raises UsageError where a thrust curve is needed and there is none.
    """
    if isinstance(model, VehicleModel):
        seen = tuple(model.dataset.get("names", ()))
        found = [nominal(model.thrust, seen, model.torque)]
        for kind, terms in model.models.items():
            beyond = _of_terms(terms)
            found.append(
                Predictor(_KIND_NAMES[kind], model.thrust, beyond, seen, model.feature_range, torque=model.torque)
            )
        return found
    record = (model.dataset or {}).get("thrust")
    own = curve_from_record(record) if record else curve
    if own is None:
        raise UsageError(f"{label}: was not fitted to recorded flights, so give an identified vehicle (a folder of"
                         " `quadexp identify`) beside it for its thrust curve")  # fmt: skip
    seen = tuple((model.dataset or {}).get("names", ()))
    if isinstance(model, GPModel):
        return [Predictor(label, own, _of_gp(model, vehicle), seen, model.feature_range, vehicle.mass)]
    return [Predictor(label, own, _of_drag(model, vehicle), seen, model.feature_range, vehicle.mass)]


_KIND_NAMES = {"linear": "linear drag", "quadratic": "quadratic drag", "blade_element": "blade element"}


def _of_terms(terms: Any) -> Acceleration:
    return lambda v, w, a: terms.acceleration(v, a)


def _of_gp(model: GPModel, vehicle: Vehicle) -> Acceleration:
    def beyond(v: np.ndarray, w: np.ndarray, a: np.ndarray) -> np.ndarray:
        seen = feature_rows(v, w, vehicle.mass * a)
        found = predict(model, seen)
        mean = np.zeros((len(v), 3)) if model.mean is None else model.mean.acceleration(seen)
        for i, axis in enumerate("xyz"):
            if f"a_{axis}" in found:
                mean[:, i] = found[f"a_{axis}"].mean
        return mean

    return beyond


def _of_drag(drag: LinearDrag, vehicle: Vehicle) -> Acceleration:
    return lambda v, w, a: drag.acceleration(feature_rows(v, w, vehicle.mass * a))
