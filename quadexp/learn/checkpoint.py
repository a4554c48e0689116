"""Checkpoints: a directory with model.json, which suffices for predictions, and report.json.

model.json is {"schema", "sha256", "payload"}; the hash is over the payload's canonical JSON (sorted keys, no spaces,
shortest decimals that give the same double), so that edits are detected and a round trip is exact. It contains no code,
and loading it imports neither torch nor CasADi.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.files.names import check_names
from quadexp.files.writer import check_output, write_folder
from quadexp.learn.checkpoint_check import check_model
from quadexp.learn.linear_drag import LinearDrag
from quadexp.learn.model import GPModel, OutputPosterior
from quadexp.learn.neural import NeuralModel
from quadexp.learn.term_mean import TermMean
from quadexp.learn.terms import TermModel
from quadexp.learn.thrust_curve import ThrustCurve
from quadexp.learn.torque import TorqueModel
from quadexp.learn.vehicle_model import VehicleModel
from quadexp.physics.vehicle import Vehicle

SCHEMA = 1
LARGEST = 100_000_000  # bytes of a model.json; six outputs of a thousand inducing points each take 60 MB
MODEL_FILE = "model.json"
REPORT_FILE = "report.json"
Model = GPModel | LinearDrag | NeuralModel | VehicleModel
KINDS = {
    GPModel: "gaussian_process",
    LinearDrag: "linear_drag",
    NeuralModel: "neural",
    VehicleModel: "vehicle_model",
}
COMMANDS = (
    "`quadexp fit-gp DATASET --out {path}`, `quadexp fit-drag DATASET --out {path}`,"
    " `quadexp fit-nn DATASET --out {path}` or `quadexp identify FLIGHT..."
    " --out {path}`"
)


def save_model(path: str | Path, model: Model, *, report: dict[str, Any] | None = None, force: bool = False) -> Path:
    """Write a checkpoint directory, complete or not at all. Returns the directory.

    report: JSON-able, written as report.json. force: replace the files of an existing checkpoint.
    Raises UsageError where the directory is not empty (without force) or cannot be written.
    """
    path = check_output(path, force=force, folder=True)
    payload = _encode(model)
    document = {"schema": SCHEMA, "sha256": _hash(payload), "payload": payload}
    files = {MODEL_FILE: json.dumps(document, allow_nan=False) + "\n"}
    if report is not None:
        files[REPORT_FILE] = json.dumps(report, indent=1) + "\n"
    return write_folder(path, files, force=force)


def load_model(path: str | Path, *, vehicle: Vehicle | None = None) -> Model:
    """Read a checkpoint directory (or its model.json).

    vehicle: for which it must have been fitted; None: any.
    Raises UsageError where there is none, DataError where it is damaged, of another schema, or for another vehicle.
    """
    path = Path(path)
    file = path / MODEL_FILE if path.is_dir() or path.suffix != ".json" else path
    if not file.is_file():
        raise UsageError(f"{path}: no model there; make one with {COMMANDS.format(path=path)}")
    try:
        size = file.stat().st_size
        if size > LARGEST:
            raise DataError(f"{file}: has {size / 1e6:.0f} MB, a model has {LARGEST / 1e6:.0f} MB at most")
        document = json.loads(file.read_text(encoding="utf-8"))
        schema, digest, payload = document["schema"], document["sha256"], document["payload"]
    except OSError as error:
        raise UsageError(f"{file}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(f"{file}: damaged, or not a model of quadexp ({_line(error)}); fit it again") from None
    if schema != SCHEMA:
        raise DataError(f"{file}: has schema {schema}, this program reads schema {SCHEMA}; fit it again")
    if _hash(payload) != digest:
        raise DataError(f"{file}: damaged or edited, its content does not match its sha256; fit it again")
    try:
        model = _decode(payload)
        check_model(model)
        check_names({"vehicle": model.vehicle}, str(file))
    except ValueError as error:
        raise DataError(f"{file}: not a valid model: {str(error).splitlines()[0]}; fit it again") from None
    except (KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise DataError(f"{file}: not a valid model, fields are missing or of a wrong type ({error})") from None
    if vehicle is not None:
        fitted = model.vehicle.get("fingerprint")
        if fitted != vehicle.fingerprint:
            raise DataError(
                f"{path}: fitted for vehicle '{model.vehicle.get('name')}' ({fitted}), not for"
                f" '{vehicle.name}' ({vehicle.fingerprint}); fit it again from this vehicle's flights"
            )
    return model


def load_report(path: str | Path) -> dict[str, Any]:
    """The report.json of a checkpoint directory, {} if it has none."""
    file = Path(path) / REPORT_FILE
    try:
        report = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    except (ValueError, RecursionError) as error:
        raise DataError(f"{file}: damaged ({_line(error)})") from None
    except OSError as error:
        raise UsageError(f"{file}: cannot be read ({error.strerror})") from None
    if not isinstance(report, dict):
        raise DataError(f"{file}: damaged (holds a {type(report).__name__}, not a mapping)")
    return report


def _line(error: Exception) -> str:
    return (f"{type(error).__name__}: {error}".splitlines() or [""])[0][:300]


def _hash(payload: Any) -> str:
    text = json.dumps(payload, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _encode(model: Model) -> dict[str, Any]:
    """The model as JSON types; a variance factor as its upper triangle, row by row."""
    payload = asdict(model)
    for output in payload.get("outputs", ()) if isinstance(model, GPModel) else ():
        factor = output["variance_factor"]
        output["variance_factor"] = factor[np.triu_indices(len(factor))]
    return {"kind": KINDS[type(model)]} | json.loads(json.dumps(payload, default=_plain, allow_nan=False))


def _plain(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def _decode(payload: dict[str, Any]) -> Model:
    content = {key: value for key, value in payload.items() if key != "kind"}
    if payload["kind"] == KINDS[LinearDrag]:
        return _drag(content)
    if payload["kind"] == KINDS[VehicleModel]:
        return _vehicle_model(content)
    if payload["kind"] == KINDS[NeuralModel]:
        return _network(content)
    if payload["kind"] != KINDS[GPModel]:
        raise ValueError(f"kind {payload['kind']!r}, allowed are {', '.join(KINDS.values())}")
    content["outputs"] = tuple(_posterior(output) for output in content["outputs"])
    content["mean"] = None if content["mean"] is None else _mean(content["mean"])
    content["linear_drag"] = _drag(content["linear_drag"])
    return GPModel(**content)


def _mean(content: dict[str, Any]) -> LinearDrag | TermMean:
    return TermMean(_terms(content["model"]), content["mass"]) if "model" in content else _drag(content)


def _drag(content: dict[str, Any]) -> LinearDrag:
    return LinearDrag(**arrays_of(content, LinearDrag))


def _network(content: dict[str, Any]) -> NeuralModel:
    layers = {key: tuple(_numbers(part, key) for part in content[key]) for key in ("weights", "biases")}
    names = {key: tuple(content[key]) for key in ("features", "outputs")}
    drag = {"linear_drag": _drag(content["linear_drag"])}
    return NeuralModel(**arrays_of(content | {"weights": (), "biases": ()}, NeuralModel) | layers | names | drag)


def _vehicle_model(content: dict[str, Any]) -> VehicleModel:
    content["thrust"] = ThrustCurve(**arrays_of(content["thrust"], ThrustCurve))
    for kind in ("linear", "quadratic", "blade_element"):
        content[kind] = None if content[kind] is None else _terms(content[kind])
    if content.get("torque") is not None:
        content["torque"] = TorqueModel(**arrays_of(content["torque"], TorqueModel))
    return VehicleModel(**content | {"notes": tuple(content["notes"])})


def _terms(content: dict[str, Any]) -> TermModel:
    per_axis = {key: tuple(_numbers(row, key) for row in content[key]) for key in ("coefficients", "covariance")}
    whole = {key: _numbers(content[key], key) for key in ("residual_std", "condition")}
    terms = {"terms": tuple(map(tuple, content["terms"])), "freedom": tuple(content["freedom"])}
    if isinstance(content["momentum"], list):
        terms["momentum"] = tuple(content["momentum"])
    return TermModel(**content | per_axis | whole | terms)


def _posterior(content: dict[str, Any]) -> OutputPosterior:
    content = arrays_of(content, OutputPosterior)
    m = len(np.atleast_1d(content["alpha"]))
    if np.shape(content["variance_factor"]) != (m * (m + 1) // 2,):
        raise ValueError(f"variance_factor needs {m * (m + 1) // 2} numbers for {m} inducing points")
    factor = np.zeros((m, m))
    factor[np.triu_indices(m)] = content["variance_factor"]
    features = tuple(content["features"])
    inducing = content["inducing"].reshape(m, len(features))
    return OutputPosterior(**content | {"variance_factor": factor, "features": features, "inducing": inducing})


def arrays_of(content: dict[str, Any], kind: type) -> dict[str, Any]:
    """The content, with the fields that the dataclass `kind` declares as arrays converted to arrays."""
    names = {f.name for f in fields(kind) if "ndarray" in str(f.type)}
    return {key: _numbers(value, key) if key in names else value for key, value in content.items()}


def _numbers(value: Any, name: str) -> Any:
    """An array from a list of numbers, or of such lists; None stays None."""
    if value is None:
        return None
    try:
        array = np.array(value)
    except ValueError:  # rows of different lengths
        array = np.array("")
    if array.dtype.kind not in "fi" and array.size:
        raise ValueError(f"{name} holds {str(value)[:60]}; numbers are needed")
    return array.astype(float)
