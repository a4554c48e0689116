"""Common form of all models that predict a flight's specific force: a thrust curve plus an acceleration.

    f = (0, 0, sum_i a_i) + a(v, w, a_1 .. a_n)          body FLU, m/s^2

nominal: the thrust curve only. An identified vehicle gives one predictor for each of its models, a GP or a drag fit
one.
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
from quadexp.learn.neural import NeuralModel
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
    """name: in tables. curve: thrust. beyond: (v (k, 3), w (k, 3), rotor accelerations (k, n)) -> (k, 3), m/s^2.

    seen: names of the flights of the fit. ranges: of the fit, see quadexp.learn.support. mass: kg, to convert rotor
    accelerations to the thrusts in the ranges. torque: fitted torque model or None.
    """

    name: str
    curve: ThrustCurve
    beyond: Acceleration
    seen: tuple[str, ...] = ()
    ranges: dict[str, Any] = field(default_factory=dict)
    mass: float = 1.0
    torque: TorqueModel | None = None


def nominal(curve: ThrustCurve, seen: tuple[str, ...] = (), torque: TorqueModel | None = None) -> Predictor:
    """The thrust curve only."""
    return Predictor(NOMINAL, curve, lambda v, w, a: np.zeros((len(v), 3)), seen, torque=torque)


def predictors(model: Any, label: str, vehicle: Vehicle, curve: ThrustCurve | None) -> list[Predictor]:
    """The predictors of a checkpoint. label: name of a GP or a drag fit. curve: for models without a thrust curve.

    Raises UsageError where there is no thrust curve.
    """
    if isinstance(model, VehicleModel):
        seen = tuple(model.dataset.get("names", ()))
        result = [nominal(model.thrust, seen, model.torque)]
        for kind, terms in model.models.items():
            beyond = _of_terms(terms)
            result.append(
                Predictor(_KIND_NAMES[kind], model.thrust, beyond, seen, model.feature_range, torque=model.torque)
            )
        return result
    record = (model.dataset or {}).get("thrust")
    own = curve_from_record(record) if record else curve
    if own is None:
        raise UsageError(f"{label}: was not fitted to recorded flights; also give an identified vehicle (a folder of"
                         " `quadexp identify`) for its thrust curve")  # fmt: skip
    seen = tuple((model.dataset or {}).get("names", ()))
    if isinstance(model, GPModel):
        return [Predictor(label, own, _of_gp(model, vehicle), seen, model.feature_range, vehicle.mass)]
    if isinstance(model, NeuralModel):
        return [Predictor(label, own, _of_network(model, vehicle), seen, model.feature_range, vehicle.mass)]
    return [Predictor(label, own, _of_drag(model, vehicle), seen, model.feature_range, vehicle.mass)]


_KIND_NAMES = {"linear": "linear drag", "quadratic": "quadratic drag", "blade_element": "blade element"}


def _of_terms(terms: Any) -> Acceleration:
    return lambda v, w, a: terms.acceleration(v, a)


def _of_gp(model: GPModel, vehicle: Vehicle) -> Acceleration:
    def beyond(v: np.ndarray, w: np.ndarray, a: np.ndarray) -> np.ndarray:
        features = feature_rows(v, w, vehicle.mass * a)
        prediction = predict(model, features)
        mean = np.zeros((len(v), 3)) if model.mean is None else model.mean.acceleration(features)
        for i, axis in enumerate("xyz"):
            if f"a_{axis}" in prediction:
                mean[:, i] = prediction[f"a_{axis}"].mean
        return mean

    return beyond


def _of_network(model: NeuralModel, vehicle: Vehicle) -> Acceleration:
    def beyond(v: np.ndarray, w: np.ndarray, a: np.ndarray) -> np.ndarray:
        found = model.predict(feature_rows(v, w, vehicle.mass * a))
        return np.stack([found.get(f"a_{axis}", np.zeros(len(v))) for axis in "xyz"], axis=1)

    return beyond


def _of_drag(drag: LinearDrag, vehicle: Vehicle) -> Acceleration:
    return lambda v, w, a: drag.acceleration(feature_rows(v, w, vehicle.mass * a))
