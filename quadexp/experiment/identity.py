"""What decides a flight: its settings, their hash, its noise, and the content of every file that it reads."""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.models.base import model_class
from quadexp.parts.part import TARGET, imported
from quadexp.parts.schema import WORLD, Config, remedies, world_parts
from quadexp.parts.settings import declared
from quadexp.physics.vehicle import FORMER_NAMES

# Groups that determine one flight, together with the world, the remedies, model and seed.
FLIGHT_GROUPS = ("vehicle", "plant", "sensor", "trajectory", "controller")
# Keys that plants of some kinds had, and the values that flights of today stand for: hashes and noise stay.
FORMER_KEYS = {"simplified": {"payload": 0.0}, "blade_element": {"payload": 0.0}}
MODEL_FILE = "model.json"
MAKER = "quadexp identify FLIGHT... --out models/NAME"  # of a model that is flown as the truth


def canonical(value: Any) -> str:
    """Canonical JSON, for hashing."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(value: Any) -> str:
    """sha256 of the canonical JSON, 20 hex digits."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()[:20]


def flight_record(config: Config) -> dict[str, Any]:
    """The part of a configuration that determines one flight, as a dictionary; parts of the world and remedies
    that do nothing are left out."""
    nodes = {group: getattr(config, group).recorded() for group in FLIGHT_GROUPS}
    nodes["plant"] |= FORMER_KEYS.get(nodes["plant"].get("kind", ""), {})
    nodes |= {group: part.recorded() for group, part in world_parts(config).items() if group not in nodes}
    nodes |= {group: part.recorded() for group, part in remedies(config).items()}
    return {**nodes, "model": config.model, "seed": config.seed}


def flight_entropy(config: Config, record: dict[str, Any] | None = None) -> int:
    """Seed of the noise of one flight: from trajectory, plant, vehicle and seed, NOT from controller or model.

    record: the flight's, where it is there already.

    Flights of different controllers have the same noise, so comparisons are paired. Keys that do not decide noise say
    so where they are declared (`noise=False`). The parts of the world are none of it: each has a stream of its own,
    which is the same whatever the others do.
    """
    nodes = record or flight_record(config)
    parts = []
    for group in ("vehicle", "plant", "trajectory"):
        keys = declared(type(getattr(config, group)))
        deciding = {k: v for k, v in nodes[group].items() if v is not None and (k not in keys or keys[k].setting.noise)}
        parts.append({FORMER_NAMES.get(k, k): v for k, v in deciding.items()})
    return int(digest(["noise", *parts, config.seed]), 16)


# -------------------------------------------------------------------------------------- checkpoints of its controller
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
    maker = model_class(residual).maker
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
            maker = model_class(kind).maker
            raise UsageError(f"controller.models: no checkpoint in {folder} for {kind}; make one: {maker}")
    files = tuple(_file(folder) for folder in controller.models)
    together = hashlib.sha256("".join(file.sha256 for file in files).encode()).hexdigest()
    return ModelFile("+".join(file.path for file in files), together, files)


def _file(folder: str) -> ModelFile:
    return ModelFile(folder, content_hash(Path(folder) / MODEL_FILE))


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


# ----------------------------------------------------------------------------------------------------- files it reads
def content_hash(path: str | Path) -> str:
    """sha256 of a file."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def model_hash(path: str) -> str:
    """Content hash of a checkpoint that is taken as the truth; UsageError where there is none."""
    file = Path(path) / MODEL_FILE
    if not file.is_file():
        raise UsageError(f"plant.model={path}: no checkpoint there; make one: {MAKER}")
    return content_hash(file)


def input_hashes(config: Config, model: ModelFile | None) -> dict[str, str]:
    """Content hash of every file that a flight reads."""
    hashes = {"model": model.sha256} if model else {}
    hashes |= source_hashes(config)
    if hasattr(config.plant, "model"):
        hashes["plant"] = model_hash(config.plant.model)
    for group, path in input_files(config).items():
        if not Path(path).is_file():
            raise UsageError(f"{group}.path={path}: no such file")
        hashes[group] = content_hash(path)
    return hashes


def input_files(config: Config) -> dict[str, str]:
    """Files besides checkpoints that a flight reads, by the group whose key `path` names them."""
    named = {group: getattr(getattr(config, group), "path", None) for group in ("trajectory", *WORLD)}
    return {group: path for group, path in named.items() if path is not None}


def source_hashes(config: Config) -> dict[str, str]:
    """sha256 of the file of every part that is a user's own, by "<group> source": one that was edited is flown anew."""
    hashes = {}
    for group in ("plant", "trajectory", "controller", *WORLD, *remedies(config)):
        part = getattr(config, group)
        named = getattr(part, TARGET, None)
        if part.shipped:
            continue
        module = inspect.getmodule(type(part) if named is None else imported(group, named))
        file = getattr(module, "__file__", None)
        hashes[f"{group} source"] = content_hash(file) if file else ""
    return hashes
