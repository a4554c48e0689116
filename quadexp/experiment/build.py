"""From a configuration to the things it names: vehicle, plant, trajectory, residual model, controller.

What is costly is made once per thread and kept: a worker flies many cells with few controllers. What is kept has a
memory, and buffers that compiled code works on, so its thread is its only owner; a flight begins by resetting it.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, cast

from quadexp.config.flight import ControllerConfig, FileConfig, MPCConfig, PlantConfig, TrajectoryConfig, VehicleConfig
from quadexp.config.learned import OnlineMPCConfig
from quadexp.config.lei_li import FeedbackConfig, RLSMPCConfig, SensorConfig
from quadexp.config.schema import Config, remedies, world_parts
from quadexp.config.settings import part
from quadexp.config.world import WorldPartConfig
from quadexp.errors import DataError, UsageError
from quadexp.experiment import build_custom, build_foreign, build_identified, build_laws, build_lei_li
from quadexp.experiment.identity import digest
from quadexp.experiment.inputs import located
from quadexp.physics.plausible import plausible
from quadexp.physics.vehicle import Vehicle

T = TypeVar("T")
# Kind -> module of quadexp.reference and class: only the one that is flown is imported, some need half of SciPy.
TRAJECTORIES = {
    "circle": ("circle", "Circle"),
    "ellipse": ("ellipse", "Ellipse"),
    "lemniscate": ("lemniscate", "Lemniscate"),
    "random": ("random_polynomial", "RandomPolynomial"),
    "hover": ("hover", "Hover"),
    "step": ("step", "Step"),
    "file": ("from_file", "FileTrajectory"),
    "rectangle": ("rectangle", "Rectangle"),
    "lei_li_circle": ("lei_li_circle", "LeiLiCircle"),
}
MODEL_FILE = "model.json"
KEPT = 64  # things kept at most, the one not used for longest goes: a sweep over plants makes a plant a cell
BELIEVERS = {"observer", "adaptive"}  # groups of remedies that tell an MPC of disturbances, see control.belief
WITHIN_LIMITS = ("random", "file")  # kinds of trajectory that are timed by the limits of the vehicle

# How to make the checkpoint that a residual needs.
MAKERS = {
    "linear_drag": "quadexp fit-drag DATASET --out models/drag",
    "gaussian_process": "quadexp fit-gp DATASET --out models/gp",
    "neural": "quadexp fit-nn DATASET --out models/nn",
}


class _Kept(threading.local):
    def __init__(self) -> None:
        self.things: dict[str, Any] = {}


_kept = _Kept()


def keep(record: Any, make: Callable[[], T]) -> T:
    """What this thread made before of an equal record, else a new one."""
    key, things = digest(record), _kept.things
    made = things.pop(key) if key in things else make()
    while len(things) >= KEPT:
        del things[next(iter(things))]
    things[key] = made
    return made


@contextlib.contextmanager
def unshared() -> Iterator[None]:
    """What is built inside is new, and nobody else gets it: parts have states, such as what a controller identified."""
    kept, _kept.things = _kept.things, {}
    try:
        yield
    finally:
        _kept.things = kept


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


def build_vehicle(config: VehicleConfig) -> Vehicle:
    """The vehicle; raises UsageError where the numbers describe none, or one of them is no multirotor's."""
    return keep(["vehicle", asdict(config)], lambda: part(Vehicle, plausible(config)))


def build_plant(vehicle: Vehicle, config: PlantConfig, believed: Vehicle | None = None) -> Any:
    """The simulated truth.

    vehicle: that is flown. believed: the one that controllers, and a model identified from flights, are made for, where
    it is another.
    """
    if believed is not None and hasattr(config, "model"):
        record = [*plant_record(vehicle, config), believed.fingerprint]
        return keep(record, lambda: build_identified.identified_plant(vehicle, config, believed))
    makers = {
        "simplified": _simplified_plant,
        "blade_element": build_lei_li.blade_element_plant,
        "custom": build_custom.custom_plant,
        "from_model": build_identified.identified_plant,
        "rotorpy": build_foreign.rotorpy_plant,
        "drone_models": build_foreign.drone_models_plant,
    }
    return keep(plant_record(vehicle, config), lambda: makers[config.kind](vehicle, config))


def plant_record(vehicle: Vehicle, config: PlantConfig) -> list[Any]:
    """What decides a plant."""
    content = build_identified.model_hash(config.model) if hasattr(config, "model") else ""
    return ["plant", vehicle.fingerprint, asdict(config), content]


def _simplified_plant(vehicle: Vehicle, config: Any) -> Any:
    from quadexp.world.simplified import PlantEffects, SimplifiedPlant

    return SimplifiedPlant(vehicle, part(PlantEffects, config), step=config.step, backend=config.backend)


def build_sensor(config: WorldPartConfig) -> Any:
    """What the controller measures specific force with; None for a perfect accelerometer, and for sensors that are
    effects (see build_world)."""
    if not isinstance(config, SensorConfig):
        return None
    bias, noise = config.accelerometer_bias, config.accelerometer_noise
    if not any(bias) and not any(noise):
        return None
    from quadexp.world.accelerometer import Accelerometer

    return Accelerometer(bias, noise)


def build_trajectory(config: TrajectoryConfig, vehicle: Vehicle | None = None) -> Any:
    """The trajectory; raises UsageError or DataError where its numbers or its file describe none.

    vehicle: whose limits decide how fast a path is flown, for the kinds that follow them (random, file); they raise
    UsageError without it. A custom trajectory never sees it.
    """
    if config.kind == "custom":
        return build_custom.custom_trajectory(config)
    others: dict[str, Any] = {}
    if isinstance(config, FileConfig):
        others["path"] = str(located(config.path))
    if config.kind in WITHIN_LIMITS:
        if vehicle is None:
            raise UsageError(f"trajectory={config.name}: is timed by the limits of a vehicle, and none was given")
        others["vehicle"] = None if config.allow_infeasible else vehicle
    module, name = TRAJECTORIES[config.kind]

    def make() -> Any:
        return part(getattr(importlib.import_module(f"quadexp.reference.{module}"), name), config, **others)

    if config.kind != "random":
        return make()
    within = others["vehicle"] and others["vehicle"].fingerprint
    return keep(["trajectory", asdict(config), within], make)  # its polynomials are costly, and the same for all


def find_model(config: Config) -> ModelFile | None:
    """The checkpoint that the controller will fly with, or None where it needs none.

    Raises UsageError where it needs one and there is none: a controller never flies with less than its name says.
    """
    controller, needed = config.controller, _learned(config)
    if not needed:
        return None
    if len(needed) > 1:
        return _several(config, needed)
    (residual,) = needed
    candidates = [config.model] if config.model else list(controller.models)
    for candidate in candidates:
        file = Path(candidate) / MODEL_FILE
        if file.is_file():
            return ModelFile(candidate, hashlib.sha256(file.read_bytes()).hexdigest())
    maker = MAKERS[residual]
    if config.model:
        raise UsageError(f"model={config.model}: no checkpoint there ({controller.name} needs one; make it: {maker})")
    looked = " or ".join(candidates) or "nowhere"
    raise UsageError(f"{controller.name} needs a model and none is in {looked}: give model=PATH, or make one: {maker}")


def _learned(config: Config) -> list[str]:
    """Kinds of the models of the controller that come from a checkpoint."""
    residual = getattr(config.controller, "residual", "none")
    return [kind for kind in ((residual,) if isinstance(residual, str) else residual) if kind in MAKERS]


def _several(config: Config, kinds: list[str]) -> ModelFile:
    """The checkpoints of a sum, one folder of controller.models for each."""
    controller = config.controller
    if config.model:
        raise UsageError(f"model={config.model}: {controller.name} sums several models; set controller.models=[..]")
    if len(controller.models) != len(kinds):
        raise UsageError(f"controller.models: {controller.name} needs one folder for each of {', '.join(kinds)}")
    found = []
    for kind, folder in zip(kinds, controller.models, strict=True):
        file = Path(folder) / MODEL_FILE
        if not file.is_file():
            raise UsageError(f"controller.models: no checkpoint in {folder} for {kind}; make one: {MAKERS[kind]}")
        found.append(ModelFile(folder, hashlib.sha256(file.read_bytes()).hexdigest()))
    together = hashlib.sha256("".join(one.sha256 for one in found).encode()).hexdigest()
    return ModelFile("+".join(one.path for one in found), together, tuple(found))


def unused_model(configs: Iterable[Config]) -> str:
    """Where `model` is given and no controller takes one, in one line; "" otherwise. In a sweep over controllers
    `model` is for those that take one."""
    without: dict[str, str] = {}
    for config in configs:
        if config.model is None or _learned(config):
            return ""
        without[config.controller.name] = config.model
    if not without:
        return ""
    names = " and ".join(without) if len(without) < 3 else f"none of {', '.join(without)}"
    verb = "takes a model" if len(without) > 2 else "take no model" if len(without) == 2 else "takes no model"
    return f"{names} {verb}: model={next(iter(without.values()))} is not used"


def input_hashes(config: Config, model: ModelFile | None) -> dict[str, str]:
    """Content hash of every file that a flight reads."""
    hashes = {"model": model.sha256} if model else {}
    hashes |= build_custom.source_hashes(config)
    if hasattr(config.plant, "model"):
        hashes["plant"] = build_identified.model_hash(config.plant.model)
    for group, path in input_files(config).items():
        if not Path(path).is_file():
            raise UsageError(f"{group}.path={path}: no such file")
        hashes[group] = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    return hashes


def input_files(config: Config) -> dict[str, str]:
    """Files besides checkpoints that a flight reads, by the group whose key `path` names them."""
    named = {group: getattr(getattr(config, group), "path", None) for group in ("trajectory", "wind")}
    return {group: path for group, path in named.items() if path is not None}


def build_residual(config: Config, vehicle: Vehicle, plant: Any, model: ModelFile | None) -> Any:
    """What the controller believes of the air: nothing, the plant's own equations, or a checkpoint."""
    from quadexp.air.none import no_residual

    kind: Any = cast(MPCConfig, config.controller).residual
    if not isinstance(kind, str):
        from quadexp.air.sum import sum_residual

        return sum_residual(residual_parts(kind, vehicle, model))
    if kind == "none":
        return no_residual(vehicle)
    if kind == "plant":
        plant.reset()  # as things stand before any change in flight
        return plant.residual()
    if kind == "custom":
        return build_custom.custom_residual(vehicle, config.controller)
    assert model is not None
    return residual_from_file(kind, vehicle, model)


def residual_parts(kinds: Iterable[str], vehicle: Vehicle, model: ModelFile | None) -> list[Any]:
    """The residuals of a sum, each from its own checkpoint."""
    files = iter(model.files if model else ())
    return [residual_from_file(kind, vehicle, next(files)) for kind in kinds]


def residual_from_file(kind: str, vehicle: Vehicle, model: ModelFile) -> Any:
    """The residual of a checkpoint."""
    return keep(["residual", kind, vehicle.fingerprint, model.sha256], lambda: _from_file(kind, vehicle, model))


def _from_file(kind: str, vehicle: Vehicle, model: ModelFile) -> Any:
    checkpoint = load_checkpoint(vehicle, model)
    checkpoint = checkpoint.linear_drag if kind == "linear_drag" else checkpoint
    if checkpoint.kind != kind:
        raise UsageError(f"{model.path}: holds {checkpoint.kind}, not {kind}, which {MAKERS[kind]} makes")
    return replace(checkpoint.residual(vehicle, model.path), ranges=checkpoint.feature_range)


def load_checkpoint(vehicle: Vehicle, model: ModelFile) -> Any:
    """The fitted model of a checkpoint. Raises DataError where it is of another vehicle, or has changed."""
    from quadexp.learn.checkpoint import load_model

    folder = located(model.path)
    if hashlib.sha256((folder / MODEL_FILE).read_bytes()).hexdigest() != model.sha256:
        raise DataError(f"{model.path}: has changed since this run began")
    return load_model(folder, vehicle=vehicle)


def build_controller(config: Config, vehicle: Vehicle, plant: Any, model: ModelFile | None) -> Any:
    """The controller; one is kept for every (configuration, model), and begins anew with every flight."""
    controller = config.controller
    told = [asdict(config.plant), [*world_parts(config)]]
    believed = told if knows_plant(controller) else model.sha256 if model else ""
    record = ["controller", vehicle.fingerprint, asdict(controller), believed]
    around = {group: asdict(one) for group, one in remedies(config).items()}

    def make() -> Any:
        if controller.kind == "custom":
            return build_custom.custom_controller(vehicle, controller)
        settings = controller_settings(controller)
        if controller.kind in build_laws.LAWS:
            residual = build_residual(config, vehicle, plant, model) if hasattr(controller, "residual") else None
            return build_laws.law(vehicle, controller, residual)
        if controller.kind == "feedback":
            return build_lei_li.feedback_controller(cast(FeedbackConfig, controller), settings, vehicle, plant)
        if controller.kind == "rls_mpc":
            return build_lei_li.identifying_mpc(cast(RLSMPCConfig, controller), settings, vehicle)
        if isinstance(controller, OnlineMPCConfig):
            from quadexp.experiment.build_learned import online_mpc

            *others, last = controller.residual
            known, files = residual_parts(others, vehicle, model), model.files if model else ()
            own = None
            if last in MAKERS:
                own = residual_from_file(last, vehicle, files[-1]), load_checkpoint(vehicle, files[-1])
            return online_mpc(controller, settings, vehicle, known, own)
        from quadexp.control.mpc.controller import PredictiveController
        from quadexp.control.mpc.mpc import ModelPredictiveController

        residual, backend = build_residual(config, vehicle, plant, model), cast(MPCConfig, controller).backend
        told_more = bool(BELIEVERS & {*around})
        if around.get("observer", {}).get("air_walk"):
            from quadexp.air.scaled import scaled_residual

            residual = scaled_residual(residual)
        mpc = ModelPredictiveController(vehicle, residual, settings, backend=backend, disturbed=told_more)
        return PredictiveController(mpc)

    if not around:
        return keep(record, make)
    from quadexp.experiment.build_remedies import with_remedies

    return keep([*record, around], lambda: with_remedies(make(), config))


def knows_plant(config: ControllerConfig) -> bool:
    """Whether the controller is told the plant's own equations or coefficients."""
    if config.kind == "feedback":
        return build_lei_li.variant(cast(FeedbackConfig, config)).parameters == "true"
    return getattr(config, "residual", "none") == "plant"


def controller_settings(config: ControllerConfig) -> Any:
    """The controller's settings, None for a law in closed form and the user's own class; raises UsageError where they
    contradict each other."""
    if config.kind == "custom" or config.kind in build_laws.LAWS:
        return None
    if config.kind == "feedback":
        from quadexp.control.feedback.settings import FeedbackSettings

        return part(FeedbackSettings, config)
    from quadexp.control.mpc.settings import MPCSettings

    return part(MPCSettings, config)
