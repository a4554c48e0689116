"""Checkpoints: a directory with model.json, which suffices for predictions, and report.json.

model.json is {"schema", "sha256", "payload"}; the hash is over the payload's canonical JSON (sorted keys, no spaces,
shortest decimals that give the same double), so that edits are detected and a round trip is exact. It contains no code,
and loading it imports neither torch nor CasADi. The payload is the model's record, field by field (base.py).
Of a user's own model it also has "equations", a hash of the code that was fitted: coefficients belong to it alone.
"""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.models.base import Model, Record, model_class
from quadexp.names import check_names, sha256_of
from quadexp.parts.models import is_shipped, kinds, model_part
from quadexp.parts.user_modules import data_of, modules_of
from quadexp.physics.vehicle import Vehicle
from quadexp.plugin import advice
from quadexp.provenance import place_hash
from quadexp.writer import check_output, write_folder

SCHEMA = 2
LARGEST = 100_000_000  # bytes of a model.json; six outputs of a thousand inducing points each take 70 MB
MODEL_FILE = "model.json"
REPORT_FILE = "report.json"


def save_model(path: str | Path, model: Model, *, report: dict[str, Any] | None = None, force: bool = False) -> Path:
    """Write a checkpoint directory, complete or not at all. Returns the directory.

    report: JSON-able, written as report.json. force: replace the files of an existing checkpoint.
    Raises UsageError where the directory is not empty (without force) or cannot be written.
    """
    path = check_output(path, force=force, folder=True)
    payload = plain(model)
    document = {"schema": SCHEMA, "sha256": _hash(payload), "payload": payload}
    if not is_shipped(model.kind):
        document["equations"] = _equations(model.kind)
    files = {MODEL_FILE: json.dumps(document, allow_nan=False) + "\n"}
    if report is not None:
        files[REPORT_FILE] = json.dumps(report, indent=1) + "\n"
    return write_folder(path, files, force=force)


def load_model(path: str | Path, *, vehicle: Vehicle | None = None, unknown: bool = False) -> Any:
    """Read a checkpoint directory (or its model.json).

    vehicle: for which it must have been fitted; None: any. unknown: also one of flights that do not say their vehicle.
    Raises UsageError where there is none, DataError where it is damaged, of another schema, or for another vehicle.
    """
    path = Path(path)
    file = path / MODEL_FILE if path.is_dir() or path.suffix != ".json" else path
    if not file.is_file():
        raise UsageError(
            f"{path}: no model there; make one with `quadexp fit MODEL DATASET --out {path}`{advice('model', path)}"
        )
    document = _decoded(file)
    schema = document.get("schema")
    digest = document.get("sha256")
    payload: Any = document.get("payload")
    if schema != SCHEMA:
        raise DataError(f"{file}: has schema {schema}, this program reads schema {SCHEMA}; fit it again")
    if _hash(payload) != digest:
        raise DataError(f"{file}: damaged or edited, its content does not match its sha256; fit it again")
    try:
        kind = payload["kind"]
        if not isinstance(kind, str):
            raise ValueError(f"kind is {str(kind)[:60]}; a text is needed")
        model: Model = record_of(payload, model_class(kind))
        check_names({"vehicle": model.vehicle}, str(file))
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{file}: not a valid model: {_line(error)}; fit it again") from None
    except UsageError as error:
        raise UsageError(f"{file}: of another model: {error}") from None
    if vehicle is not None:
        fitted = model.vehicle.get("fingerprint")
        if fitted != vehicle.fingerprint and not (unknown and fitted is None):
            raise DataError(
                f"{path}: fitted for vehicle '{model.vehicle.get('name')}' ({fitted}), not for '{vehicle.name}'"
                f" ({vehicle.fingerprint}): pass the vehicle=... of its flights, or fit it again from this vehicle's"
            )
    return model


def edited_note(path: str | Path) -> str:
    """Of a checkpoint whose equations were edited after its fit, that they were, in one line; "" for any other, and
    where the --conf folder of its equations is not given."""
    fitted = _decoded(Path(path) / MODEL_FILE).get("equations", "")
    if not fitted:
        return ""
    kind = load_model(path).kind
    if kind not in kinds() or fitted == _equations(kind):
        return ""
    return f"{path}: fitted with other equations than {kind}.py, or what it imports, has now: fit it again"


def load_report(path: str | Path) -> dict[str, Any]:
    """The report.json of a checkpoint directory, {} if it has none."""
    file = Path(path) / REPORT_FILE
    if not file.is_file():
        return {}
    return _decoded(file)


def _equations(kind: str) -> str:
    """Hash of the code of a user's model: the statements of its module, and of those of the user's that it imports,
    without comments, docstrings and layout; and of the data that they name."""
    hashes = {}
    for name, path in sorted(modules_of([type(model_part(kind)).__module__])[2].items()):
        hashes[name] = sha256_of(_statements(path)) if path.suffix == ".py" else place_hash(path)
        hashes |= {f"{name} {text}": place_hash(place) for text, place in data_of(name, path).items()}
    return _hash(hashes)


def _statements(path: Path) -> str:
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        if not isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
            continue
        if ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return ast.dump(tree)


def _decoded(file: Path) -> dict[str, Any]:
    """What a JSON file holds. Raises UsageError where it cannot be read, DataError where it is damaged."""
    try:
        size = file.stat().st_size
        if size > LARGEST:
            raise DataError(f"{file}: has {size / 1e6:.0f} MB, a model has {LARGEST / 1e6:.0f} MB at most")
        return msgspec.json.decode(file.read_bytes(), type=dict[str, Any])
    except OSError as error:
        raise UsageError(f"{file}: cannot be read ({error.strerror})") from None
    except (ValueError, msgspec.MsgspecError, RecursionError) as error:
        raise DataError(f"{file}: damaged, or not a model of quadexp ({_line(error)}); fit it again") from None


def _line(error: Exception) -> str:
    return (f"{type(error).__name__}: {error}".splitlines() or [""])[0][:300]


def _hash(payload: Any) -> str:
    text = json.dumps(payload, sort_keys=True, separators=(",", ":"))
    return sha256_of(text)


def plain(record: Record) -> Any:
    """A record as JSON types."""
    return msgspec.to_builtins(record, enc_hook=lambda array: array.tolist())


def record_of(content: Any, kind: Any) -> Any:
    """The record, or one of several kinds, from JSON types. Raises ValueError naming the field that is wrong."""
    return msgspec.convert(content, kind, dec_hook=_array)


def _array(kind: type, value: Any) -> np.ndarray:
    """An array from a list of finite numbers, or of such lists."""
    assert kind is np.ndarray
    try:
        array = np.array(value)
    except ValueError:  # rows of different lengths
        array = np.array("")
    if array.dtype.kind not in "fi" and array.size or not array.ndim:
        raise ValueError(f"holds {str(value)[:60]}; numbers are needed")
    array = array.astype(float)
    if not np.isfinite(array).all():
        raise ValueError(f"holds {str(value)[:60]}; finite numbers are needed")
    return array
