"""What decides a flight, in one place: `flight_identity`.

    settings   the recorded ones of every part, the seed                                  `record`
    content    of every file that is read: checkpoints, wind, paths, whatever a user's part names       `inputs`
    code       a user's classes and all modules behind them; packages that not every flight imports     `inputs`
    program    the sources of this package behind this flight, and the libraries that they import       `program`

The first three make the key of a cell (sweeps/plan.py). A cell of another program is distinguished when it is recalled,
so that its user can keep it. What is kept within a process, and what a worker compares with the driver, is given by the
same (`part_identity`).
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import platform
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from quadexp.errors import QuadexpError, UsageError
from quadexp.names import sha256_of
from quadexp.parts.former import hashed
from quadexp.parts.models import is_shipped, maker, model_part
from quadexp.parts.part import Part
from quadexp.parts.schema import Config, remedies, world_parts
from quadexp.parts.settings import declared
from quadexp.parts.user_modules import OWN, data_of, modules_of
from quadexp.physics.vehicle import FORMER_NAMES
from quadexp.provenance import (
    content_hash,
    flying,
    model_modules,
    numeric_versions,
    package_folder,
    package_identity,
    place_hash,
    program_of,
    served,
    sources,
)

# Groups that determine one flight, together with the world, the remedies, model and seed.
FLIGHT_GROUPS = ("vehicle", "plant", "sensor", "trajectory", "controller")
MODEL_FILE = "model.json"
FITTING = (f"{OWN}.experiment.collect", f"{OWN}.experiment.fit")  # make a model of flights, with these services
FITTING_SERVICES = ("delivered_rows",)
_CLASSES = itertools.count()


def canonical(value: Any) -> str:
    """Canonical JSON, for hashing."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(value: Any) -> str:
    """sha256 of the canonical JSON, 20 hex digits."""
    return sha256_of(canonical(value))[:20]


def flying_parts(config: Config) -> dict[str, Part]:
    """The parts that determine one flight, by group; those of the world and remedies that do nothing are left out."""
    return {group: getattr(config, group) for group in FLIGHT_GROUPS} | world_parts(config) | remedies(config)


def flight_record(config: Config, parts: Mapping[str, Part] | None = None) -> dict[str, Any]:
    """The part of a configuration that determines one flight, as a dictionary. parts: see flying_parts."""
    nodes = {group: part.recorded() for group, part in (parts or flying_parts(config)).items()}
    nodes["plant"] |= config.plant.former_keys
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
    made_by = controller.makes or maker(residual)
    advice = f"give model=PATH, or make one: {made_by}"
    if config.model:
        needs = f"{controller.name} needs one; make it: {made_by}"
        raise UsageError(f"model={config.model}: no checkpoint there ({needs})")
    looked = " or ".join(candidates) or "nowhere"
    raise UsageError(f"{controller.name} needs a model and none is in {looked}: {advice}")


def _several(config: Config, kinds: tuple[str, ...]) -> ModelFile:
    """The checkpoints of a sum, one folder of controller.models for each."""
    controller = config.controller
    if config.model:
        raise UsageError(f"model={config.model}: {controller.name} sums several models; set controller.models=[..]")
    if len(controller.models) != len(kinds):
        raise UsageError(f"controller.models: {controller.name} needs one folder for each of {', '.join(kinds)}")
    for kind, folder in zip(kinds, controller.models, strict=True):
        if not (Path(folder) / MODEL_FILE).is_file():
            raise UsageError(f"controller.models: no checkpoint in {folder} for {kind}; make one: {maker(kind)}")
    files = tuple(_file(folder) for folder in controller.models)
    together = sha256_of("".join(file.sha256 for file in files))
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
    verbs = {1: "takes no model", 2: "take no model"}
    verb = verbs.get(len(without), "takes a model")
    return f"{names} {verb}: model={next(iter(without.values()))} is not used"


def edited_models(configs: Iterable[Config]) -> list[str]:
    """A line for each checkpoint, of a controller or a plant, whose equations were edited after its fit."""
    from quadexp.models.checkpoint import edited_note

    folders: dict[str, None] = {}
    for config in configs:
        file = None if all(map(is_shipped, config.controller.learned)) else find_model(config)
        folders |= dict.fromkeys(single.path for single in (file.files if file else ()))
        stated = getattr(config.plant, "model", None)
        folders |= {stated: None} if isinstance(stated, str) else {}
    return list(filter(None, map(edited_note, folders)))


# ------------------------------------------------------------------------------------------- files, code and packages
class Decides(NamedTuple):
    """What decides a part besides its settings. files: by name. texts: what stands for those that were executed, and
    for what lies in no file. modules: of this package, that it is made of. packages: others that a user's modules
    import."""

    files: dict[str, Path]
    texts: dict[str, str]
    modules: frozenset[str]
    packages: frozenset[str] = frozenset()

    def inputs(self) -> dict[str, str]:
        """Hashes by name."""
        return {name: place_hash(path) for name, path in self.files.items()} | self.texts


def decides(group: str, part: Part) -> Decides:
    """The files that a part reads, and of a user's own part its class, all of the user's modules behind it, the files
    that these or its settings name, and the packages that they import.

    Raises UsageError where a file is missing.
    """
    if part.shipped:
        return Decides(_shipped_files(group, part), {}, frozenset({type(part).__module__}))
    behind = {kind.__module__: kind for kind in reversed(type(part).__mro__)}
    code, elsewhere, modules = modules_of(behind)
    texts = {f"{group} class": part.class_path} | {f"{group} module {name}": content for name, content in code.items()}
    own_packages = {name.partition(".")[0] for name in modules}
    tops = {name.partition(".")[0] for name in elsewhere} - sys.stdlib_module_names - own_packages - {OWN}
    outside = {name for name in behind if name in elsewhere and name.partition(".")[0] in tops}
    texts |= {f"{group} module {name}": _outside(behind[name]) for name in outside}
    settings = {key: value for key, value in part.recorded().items() if key != "name"}
    named = {text: Path(text) for text in _texts(settings) if _is_data(text)}
    for name, path in modules.items():
        named |= data_of(name, path)
    files = {f"{group} module {name}": path for name, path in modules.items()}
    files |= {f"{group} file {text}": place for text, place in named.items()}
    shipped = frozenset(name for name in elsewhere if name.startswith(f"{OWN}."))
    return Decides(files, texts, shipped, frozenset(tops - {name.partition(".")[0] for name in outside}))


def _shipped_files(group: str, part: Part) -> dict[str, Path]:
    """Files that a part of this program reads, a checkpoint only where it is taken as the truth."""
    if hasattr(part, "path"):
        if not Path(part.path).is_file():
            raise UsageError(f"{group}.path={part.path}: no such file")
        return {group: Path(part.path)}
    if group != "plant" or not hasattr(part, "model"):
        return {}
    file = Path(part.model) / MODEL_FILE
    if not file.is_file():
        raise UsageError(f"plant.model={part.model}: no checkpoint there; make one: {part.makes}")
    return {group: file}


def part_identity(group: str, part: Part) -> list[Any]:
    """What decides a part, as plain data."""
    return [part.recorded(), decides(group, part).inputs()]


@cache
def _outside(kind: type) -> str:
    """Of a class that lies in none of the user's folders: the content of its file, or a number that is its own."""
    file = getattr(sys.modules.get(kind.__module__), "__file__", None)
    return content_hash(file) if file else f"class {next(_CLASSES)}"


def _is_data(text: str) -> bool:
    """Whether a text names a file, or a folder that this process does not stand in."""
    return os.path.isfile(text) or (os.path.isdir(text) and not Path.cwd().is_relative_to(Path(text).resolve()))


def _texts(value: Any) -> Iterator[str]:
    """All texts in plain data."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, (list, tuple, dict)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _texts(item)


# ------------------------------------------------------------------------------------------------------------- a flight
@dataclass(frozen=True)
class FlightIdentity:
    """What decides a flight; see the module. model: the checkpoint of its controller. files: hashes by path."""

    record: dict[str, Any]
    model: ModelFile | None
    inputs: dict[str, str]
    files: dict[str, str]
    program: str

    @property
    def digest(self) -> str:
        """Hash of all of it."""
        return digest([hashed(self.record), self.inputs, self.program])

    @property
    def code(self) -> str:
        """What a row says of its program: `program`, bound to the sources that it names."""
        return digest([sources(), self.program])


def flight_identity(config: Config, known: dict[Any, Any] | None = None) -> FlightIdentity:
    """What decides a flight, as files are now. known: what was found of parts of other flights of the same plan.

    Raises UsageError where a file that it needs does not exist.
    """
    known = {} if known is None else known
    place = id(config.controller), config.model
    if place not in known:
        known[place] = config.controller, find_model(config)
    return identity_with(config, known[place][1], known)


def identity_with(
    config: Config, model: ModelFile | None, known: dict[Any, Any] | None = None, *, fitted: bool = False
) -> FlightIdentity:
    """That of a flight with a checkpoint, or without; see flight_identity. fitted: of a model that is fitted to such
    flights."""
    known = {} if known is None else known
    parts = flying_parts(config)
    record = flight_record(config, parts)
    if model is None:
        record["model"] = None  # a checkpoint that is not used decides nothing
    inputs = {"model": model.sha256} if model else {}
    files = {f"{file.path}/{MODEL_FILE}": file.sha256 for file in model.files} if model else {}
    modules = {*flying(), *((*FITTING, *served(*FITTING_SERVICES)) if fitted else ())}
    packages = set[str]()
    for group, part in {**parts, **_own_models(config, model)}.items():
        if (group, id(part)) not in known:
            deciding = decides(group, part)
            known[group, id(part)] = part, deciding, deciding.inputs()
        _, of_part, contents = known[group, id(part)]
        inputs |= contents
        files |= {str(path): contents[name] for name, path in of_part.files.items() if path.is_file()}
        modules |= of_part.modules
        packages |= of_part.packages
    modules |= model_modules(package_folder()) if fitted else set()
    with_model = bool(model) or "model" in record["plant"]
    program, others = _program(frozenset(modules), frozenset(packages), with_model)
    for name in others:
        if name not in known:
            known[name] = package_identity(name)
        inputs[f"package {name}"] = known[name]
    places = {os.path.abspath(path): content for path, content in files.items()}
    return FlightIdentity(record, model, inputs, places, program)


def _own_models(config: Config, model: ModelFile | None) -> dict[str, Part]:
    """A user's own models of the air behind checkpoints of the controller and of the plant, whose code decides too."""
    kinds = [kind for kind in config.controller.learned if kind in config.controller.kinds] if model else []
    stated = getattr(config.plant, "model", None)
    if isinstance(stated, str):
        with contextlib.suppress(QuadexpError, OSError):  # said where it is read to be flown
            kinds.append(_kind_of(content_hash(Path(stated) / MODEL_FILE), stated))
    return {f"model {kind}": model_part(kind) for kind in kinds if not is_shipped(kind)}


@cache
def _kind_of(content: str, folder: str) -> str:
    """The kind of a checkpoint's model. content: its hash."""
    from quadexp.models.checkpoint import load_model

    return str(load_model(folder).kind)


@cache
def _program(modules: frozenset[str], packages: frozenset[str], with_model: bool) -> tuple[str, frozenset[str]]:
    """Hash of the sources of this package and of the libraries that some modules are made of; and the packages that not
    every flight imports. packages: that a user's modules import. with_model: whether a checkpoint is read, by the
    module that it names; what this one imports for a fit decides no flight."""
    program = program_of(modules)
    always = program_of(flying()).packages
    readers = model_modules(package_folder()) if with_model else set()
    behind = [program_of(modules | readers).sources, platform.python_version()]
    libraries = numeric_versions(program.packages | packages)
    others = (program.packages - always) | packages
    return digest([*behind, libraries]), others - numeric_versions(others).keys()
