"""Validation of a checkpoint's content: declared types, finite numbers, matching array shapes.

A checkpoint is JSON with a hash that anybody can compute, so its content is validated before use. Errors name the
field, such as `outputs[0].lengthscale`.
"""

from __future__ import annotations

import types
from dataclasses import fields, is_dataclass
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from quadexp.learn.linear_drag import LinearDrag
from quadexp.learn.model import GPModel, OutputPosterior
from quadexp.learn.neural import NeuralModel
from quadexp.learn.samples import SIGNALS
from quadexp.learn.term_mean import TermMean
from quadexp.learn.terms import UNITS, TermModel
from quadexp.learn.thrust_curve import ThrustCurve
from quadexp.learn.vehicle_model import VehicleModel
from quadexp.physics.correction import OUTPUTS


def check_model(model: Any) -> None:
    """Raise ValueError naming the first invalid field."""
    _check(model, type(model), "")


def _check(value: Any, hint: Any, where: str) -> None:
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        allowed = get_args(hint)
        if value is None and type(None) in allowed:
            return
        chosen = [one for one in allowed if one is type(value) or get_origin(one) is type(value)]
        hint = chosen[0] if chosen else next(one for one in allowed if one is not type(None))
        _check(value, hint, where)
    elif isinstance(hint, type) and is_dataclass(hint):
        _require(isinstance(value, hint), where, value, f"{hint.__name__} is needed")
        hints = get_type_hints(hint)
        for f in fields(hint):
            _check(getattr(value, f.name), hints[f.name], f"{where}.{f.name}".lstrip("."))
        if hint in _RELATIONS:
            _RELATIONS[hint](value, where)
    elif hint is np.ndarray:
        valid = isinstance(value, np.ndarray) and value.dtype.kind == "f" and bool(np.all(np.isfinite(value)))
        _require(valid, where, value, "finite numbers are needed")
    elif hint in (float, int):
        number = isinstance(value, int) or (hint is float and isinstance(value, float) and np.isfinite(value))
        _require(number and not isinstance(value, bool), where, value, f"a finite {hint.__name__} is needed")
    elif hint is str:
        _require(isinstance(value, str), where, value, "text is needed")
    elif origin in (tuple, list):
        _require(isinstance(value, origin), where, value, "a list is needed")
        for i, item in enumerate(value):
            _check(item, get_args(hint)[0], f"{where}[{i}]")
    elif origin is dict:
        _require(isinstance(value, dict), where, value, "a mapping is needed")
        for key, item in value.items():
            _check(item, get_args(hint)[1], f"{where}[{key!r}]")


def _require(valid: bool, where: str, value: Any, needed: str) -> None:
    if not valid:
        text = " ".join(str(value).split())
        raise ValueError(f"{where or 'the model'} is {text[:60]}{'...' if len(text) > 60 else ''}; {needed}")


def _shape(array: np.ndarray, shape: tuple[int, ...], where: str) -> None:
    _require(array.shape == shape, where, f"of shape {array.shape}", f"{shape} is needed")


def _posterior(one: OutputPosterior, where: str) -> None:
    m, d = len(one.alpha), len(one.features)
    _require(one.output in OUTPUTS, f"{where}.output", one.output, f"one of {', '.join(OUTPUTS)} is needed")
    _require(m > 0 and d > 0, where, "without inducing points or features", "both are needed")
    _shape(one.alpha, (m,), f"{where}.alpha")
    _shape(one.inducing, (m, d), f"{where}.inducing")
    _shape(one.variance_factor, (m, m), f"{where}.variance_factor")
    _shape(one.lengthscale, (d,), f"{where}.lengthscale")
    _require(bool(np.all(one.lengthscale > 0)), f"{where}.lengthscale", one.lengthscale, "more than 0 is needed")
    _require(one.signal_variance > 0, f"{where}.signal_variance", one.signal_variance, "more than 0 is needed")
    _require(one.noise_variance >= 0, f"{where}.noise_variance", one.noise_variance, "0 or more is needed")


def _gp(model: GPModel, where: str) -> None:
    _require(len(model.outputs) > 0, "outputs", "empty", "at least one is needed")
    names = [one.output for one in model.outputs]
    _require(len(set(names)) == len(names), "outputs", ", ".join(names), "each is allowed once")
    for feature, limits in model.feature_range.items():
        ordered = len(limits) == 2 and limits[0] <= limits[1]
        _require(ordered, f"feature_range[{feature!r}]", limits, "[least, largest] is needed")


def _neural(model: NeuralModel, where: str) -> None:
    for output in model.outputs:
        _require(output in OUTPUTS, "outputs", output, f"one of {', '.join(OUTPUTS)} is needed")
    _require(len(set(model.outputs)) == len(model.outputs), "outputs", ", ".join(model.outputs), "each is allowed once")
    shapes = ", ".join(str(w.shape) for w in model.weights)
    _require(model.shapes_fit(), "weights", f"of the shapes {shapes}", "matrices that fit features, biases and outputs")
    _shape(model.residual_std, (len(model.outputs),), "residual_std")


def _drag(model: LinearDrag, where: str) -> None:
    for name in ("drag", "intercept", "drag_error", "intercept_error", "residual_std", "r_squared"):
        _shape(getattr(model, name), (3,), f"{where}.{name}".lstrip("."))


def _mean(model: TermMean, where: str) -> None:
    _require(model.mass > 0, f"{where}.mass", model.mass, "more than 0 is needed")


def _curve(curve: ThrustCurve, where: str) -> None:
    _require(curve.signal in SIGNALS, f"{where}.signal", curve.signal, f"one of {', '.join(SIGNALS)} is needed")
    _require(1 <= curve.rotors <= 64, f"{where}.rotors", curve.rotors, "1 to 64 are needed")
    q = len(curve.powers)
    _shape(curve.powers, (q,), f"{where}.powers")
    for name in ("coefficients", "errors"):
        array = getattr(curve, name)
        shaped = array.shape in ((q,), (curve.rotors, q)) and q > 0
        _require(shaped, f"{where}.{name}", f"of shape {array.shape}", f"{(q,)} or {(curve.rotors, q)} is needed")
    if curve.signal_range is not None:
        _shape(curve.signal_range, (2,), f"{where}.signal_range")


def _terms(model: TermModel, where: str) -> None:
    for name in ("terms", "coefficients", "covariance", "freedom"):
        _require(len(getattr(model, name)) == 3, f"{where}.{name}", len(getattr(model, name)), "three axes are needed")
    for i, names in enumerate(model.terms):
        unknown = [name for name in names if name not in UNITS]
        _require(not unknown, f"{where}.terms[{i}]", ", ".join(unknown), f"allowed are {', '.join(UNITS)}")
        _shape(model.coefficients[i], (len(names),), f"{where}.coefficients[{i}]")
        _require(
            model.covariance[i].size == len(names) ** 2, f"{where}.covariance[{i}]",
            f"of shape {model.covariance[i].shape}", f"{(len(names),) * 2} is needed",
        )  # fmt: skip
    _require(1 <= model.rotors <= 64, f"{where}.rotors", model.rotors, "1 to 64 are needed")
    for name in ("residual_std", "condition"):
        _shape(getattr(model, name), (3,), f"{where}.{name}")


def _vehicle(model: VehicleModel, where: str) -> None:
    _require(model.best in model.models, "best", model.best, f"one of {', '.join(model.models)} is needed")


_RELATIONS: dict[type, Any] = {
    OutputPosterior: _posterior,
    GPModel: _gp,
    LinearDrag: _drag,
    NeuralModel: _neural,
    TermMean: _mean,
    ThrustCurve: _curve,
    TermModel: _terms,
    VehicleModel: _vehicle,
}
