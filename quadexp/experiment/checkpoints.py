"""Checkpoints that a flight uses: which one a controller flies with, and the model of the air that it holds."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from quadexp.errors import DataError, UsageError
from quadexp.experiment.kept import keep
from quadexp.models.settings import MAKERS
from quadexp.parts.schema import Config
from quadexp.physics.vehicle import Vehicle

MODEL_FILE = "model.json"
MAKER = "quadexp identify FLIGHT... --out models/NAME"  # of a model that is flown as the truth


@dataclass(frozen=True)
class ModelFile:
    """A checkpoint folder and the hash of its content; of a sum, all folders with "+" between, and those as parts."""

    path: str
    sha256: str
    parts: tuple[ModelFile, ...] = ()

    @property
    def files(self) -> tuple[ModelFile, ...]:
        """The single checkpoints."""
        return self.parts or (self,)


def find_model(config: Config) -> ModelFile | None:
    """The checkpoint that the controller will fly with, or None where it needs none.

    Raises UsageError where it needs one and there is none: a controller never flies with less than its name says.
    """
    controller = config.controller
    needed = controller.learned
    if not needed:
        return None
    if len(needed) > 1:
        return _several(config, needed)
    (residual,) = needed
    candidates = [config.model] if config.model else list(controller.models)
    for candidate in candidates:
        if (Path(candidate) / MODEL_FILE).is_file():
            return _file(candidate)
    maker = MAKERS[residual]
    if config.model:
        raise UsageError(f"model={config.model}: no checkpoint there ({controller.name} needs one; make it: {maker})")
    looked = " or ".join(candidates) or "nowhere"
    raise UsageError(f"{controller.name} needs a model and none is in {looked}: give model=PATH, or make one: {maker}")


def _several(config: Config, kinds: tuple[str, ...]) -> ModelFile:
    """The checkpoints of a sum, one folder of controller.models for each."""
    controller = config.controller
    if config.model:
        raise UsageError(f"model={config.model}: {controller.name} sums several models; set controller.models=[..]")
    if len(controller.models) != len(kinds):
        raise UsageError(f"controller.models: {controller.name} needs one folder for each of {', '.join(kinds)}")
    for kind, folder in zip(kinds, controller.models, strict=True):
        if not (Path(folder) / MODEL_FILE).is_file():
            raise UsageError(f"controller.models: no checkpoint in {folder} for {kind}; make one: {MAKERS[kind]}")
    files = tuple(_file(folder) for folder in controller.models)
    together = hashlib.sha256("".join(file.sha256 for file in files).encode()).hexdigest()
    return ModelFile("+".join(file.path for file in files), together, files)


def _file(folder: str) -> ModelFile:
    return ModelFile(folder, hashlib.sha256((Path(folder) / MODEL_FILE).read_bytes()).hexdigest())


def unused_model(configs: Iterable[Config]) -> str:
    """Where `model` is given and no controller takes one, in one line; "" otherwise. In a sweep over controllers
    `model` is for those that take one."""
    without: dict[str, str] = {}
    for config in configs:
        if config.model is None or config.controller.learned:
            return ""
        without[config.controller.name] = config.model
    if not without:
        return ""
    names = " and ".join(without) if len(without) < 3 else f"none of {', '.join(without)}"
    verb = "takes a model" if len(without) > 2 else "take no model" if len(without) == 2 else "takes no model"
    return f"{names} {verb}: model={next(iter(without.values()))} is not used"


def load_checkpoint(vehicle: Vehicle, model: ModelFile) -> Any:
    """The fitted model of a checkpoint. Raises DataError where it is of another vehicle, or has changed."""
    from quadexp.models.checkpoint import load_model

    folder = Path(model.path)
    if hashlib.sha256((folder / MODEL_FILE).read_bytes()).hexdigest() != model.sha256:
        raise DataError(f"{model.path}: has changed since this run began")
    return load_model(folder, vehicle=vehicle)


def residuals(kinds: Iterable[str], vehicle: Vehicle, model: ModelFile | None) -> list[Any]:
    """The models of the air of some kinds, each from its own checkpoint."""
    files = iter(model.files if model else ())
    return [_residual(kind, vehicle, next(files)) for kind in kinds if kind in MAKERS]


def _residual(kind: str, vehicle: Vehicle, model: ModelFile) -> Any:
    return keep(["residual", kind, vehicle.fingerprint, model.sha256], lambda: _from_file(kind, vehicle, model))


def _from_file(kind: str, vehicle: Vehicle, model: ModelFile) -> Any:
    checkpoint = load_checkpoint(vehicle, model)
    checkpoint = checkpoint.linear_drag if kind == "linear_drag" else checkpoint
    if checkpoint.kind != kind:
        raise UsageError(f"{model.path}: holds {checkpoint.kind}, not {kind}, which {MAKERS[kind]} makes")
    return replace(checkpoint.residual(vehicle, model.path), ranges=checkpoint.feature_range)


# --------------------------------------------------------------------------------- a model that is flown as the truth
def model_hash(path: str) -> str:
    """Content hash of a checkpoint; UsageError where there is none."""
    file = Path(path) / MODEL_FILE
    if not file.is_file():
        raise UsageError(f"plant.model={path}: no checkpoint there; make one: {MAKER}")
    return hashlib.sha256(file.read_bytes()).hexdigest()


def load_identified(path: str | Path, vehicle: Vehicle) -> Any:
    """A checkpoint for this vehicle; one of flights that do not say their vehicle is taken as it is.

    Raises UsageError where it was fitted for another vehicle.
    """
    from quadexp.models.checkpoint import load_model

    model = load_model(path)
    if model.vehicle.get("fingerprint") not in (None, vehicle.fingerprint):
        raise UsageError(
            f"{path}: fitted for vehicle '{model.vehicle.get('name')}' ({model.vehicle.get('fingerprint')}), not for"
            f" '{vehicle.name}' ({vehicle.fingerprint}): pass the vehicle=... of its flights"
        )
    return model


def model_residual(vehicle: Vehicle, path: Path, kind: str = "best") -> Any:
    """The residual of a checkpoint. kind: which model of an identified vehicle, "best" for its own choice.

    Raises UsageError where the checkpoint has none of that kind.
    """
    return load_identified(path, vehicle).residual(vehicle, str(path), kind)
