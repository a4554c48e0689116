"""From a configuration to what it names: each part is made in its turn, and handed what it asks for.

vehicle -> world (plant and effects) -> trajectory, controller with its model of the air -> remedies around it

What is costly is made once per thread and kept: a worker flies many cells with few controllers. What is kept has a
memory, and buffers that compiled code works on, so its thread is its only owner; a flight begins by resetting it.
"""

from __future__ import annotations

import contextlib
import marshal
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from quadexp.control.part import GIVEN
from quadexp.errors import DataError, UsageError
from quadexp.experiment.identity import MODEL_FILE, ModelFile, part_identity
from quadexp.models.build_context import BuildContext
from quadexp.parts.former import ATTRIBUTES
from quadexp.parts.models import maker
from quadexp.parts.part import Part
from quadexp.parts.schema import Config, remedies, world_parts
from quadexp.parts.sensor_spec import SensorSpec, Stated
from quadexp.parts.user_modules import generation
from quadexp.physics.vehicle import Vehicle, plausible
from quadexp.provenance import content_hash
from quadexp.reference.base import check_own

T = TypeVar("T")
KEPT = 64  # things kept at most, the one not used for longest goes: a sweep over plants makes a plant a cell
# What of a seam is looked for, so that something else is refused before the flight and not in it.
SEAMS = {
    "trajectory": ("duration", "peak_speed", "flat_output"),
    "plant": ("vehicle", "reset", "advance", "residual"),
    "controller": (
        "vehicle", "control_period", "node_times", "reference_period", "residual", "backend", "residual_name", "source",
        "forget", "reset", "step", "log",
    ),
}  # fmt: skip


class _Kept(threading.local):
    def __init__(self) -> None:
        self.things: dict[bytes, Any] = {}


_kept = _Kept()


def cached(record: Any, make: Callable[[], T]) -> T:
    """What this thread made before of an equal record, else a new one."""
    things = _kept.things
    key = marshal.dumps([generation(), record], 2)  # of version 2 equal ones have equal bytes
    thing = things.pop(key) if key in things else make()
    while len(things) >= KEPT:
        del things[next(iter(things))]
    things[key] = thing
    return thing


@contextlib.contextmanager
def unshared() -> Iterator[None]:
    """What is built inside is new, and nobody else gets it: parts have states, such as what a controller identified."""
    kept = _kept.things
    _kept.things = {}
    try:
        yield
    finally:
        _kept.things = kept


def build_vehicle(config: Vehicle) -> Vehicle:
    """The vehicle; raises UsageError where one of its numbers is no multirotor's."""
    return cached(["vehicle", config.recorded()], lambda: plausible(config))


# ----------------------------------------------------------------------------------------------------------- the world
def build_plant(vehicle: Vehicle, config: Any, believed: Vehicle | None = None) -> Any:
    """The simulated truth.

    vehicle: that is flown. assumed: the one that controllers, and a model identified from flights, are made for, where
    it is another.
    """
    of = believed or vehicle
    context = BuildContext(
        vehicle=vehicle, assumed_vehicle=of, plant_model=lambda path, kind: model_residual(of, Path(path), kind)
    )
    record = ["plant", vehicle.fingerprint, of.fingerprint, part_identity("plant", config)]
    return cached(record, lambda: checked("plant", config, config.anew().build(context)))


def build_world(config: Config, vehicle: Vehicle) -> Any:
    """The plant in its world; the plant itself where no part of the world does anything.

    vehicle: the one that controllers assume.
    Raises UsageError where the plant is none of the shared integrator, which the effects need.
    """
    parts = world_parts(config)
    believed = build_plant(vehicle, config.plant)
    if not parts:
        return believed
    from quadexp.world.integrator import SimulatedPlant
    from quadexp.world.world import World

    _check_one_lag(config, believed)
    effects, true_vehicle = build_effects(vehicle, *parts.values())
    around = {group: part_identity(group, part) for group, part in parts.items()}
    record = ["world", vehicle.fingerprint, part_identity("plant", config.plant), around]

    def make() -> Any:
        flown = _with_drag(config)
        same = true_vehicle is vehicle and flown is config.plant
        airframe = believed if same else build_plant(true_vehicle, flown, vehicle)
        if not isinstance(airframe, SimulatedPlant) or type(airframe).advance is not SimulatedPlant.advance:
            said = ",".join(f"{group}={part.name}" for group, part in parts.items())
            raise UsageError(
                f"{said}: needs a plant that is a SimulatedPlant (quadexp/world/integrator.py);"
                f" plant={config.plant.name} has an `advance` of its own, and flies without"
            )
        return World(airframe, effects, believed)

    return cached(record, make)


def build_effects(vehicle: Vehicle, *parts: Any) -> tuple[list[Any], Vehicle]:
    """The effects of parts of a world, and the vehicle that is flown in it.

    vehicle: the one that controllers assume. Raises UsageError where a file is missing, or the flown vehicle could
    not hover.
    """
    effects = [_with_file(part.anew()) for part in parts]
    for effect in effects:
        vehicle = effect.true_vehicle(vehicle)
    return effects, vehicle


def _with_file(part: Any) -> Any:
    """The part; UsageError where it names a file that is not there."""
    if not Path(getattr(part, "path", __file__)).is_file():
        raise UsageError(f"{part.prefix}path: there is no file {str(part.path)!r}")
    return part


def _check_one_lag(config: Config, plant: Any) -> None:
    """Raise UsageError where the plant's own lag and that of the actuator would act one after the other."""
    if not max(getattr(config.actuator, f"time_constant_{way}", 0.0) for way in ("up", "down")):
        return
    stated = getattr(config.plant, "motor_lag", 0.0)
    if lag := stated or getattr(plant, "loop_lag", 0.0):
        raise UsageError(
            f"plant={config.plant.name} and actuator={config.actuator.name}: both let the rotors lag, the plant's own"
            f" by {1e3 * lag:.0f} ms; set {'plant.motor_lag=0, or ' if stated else ''}actuator.time_constant_up=0"
            " actuator.time_constant_down=0"
        )


def _with_drag(config: Config) -> Any:
    """The plant with `truth.drag` times its drag and lift. Raises UsageError where it has none of these settings."""
    factor = getattr(config.truth, "drag", 1.0)
    plant = config.plant
    names = ("linear_drag", "quadratic_drag")
    if factor == 1.0:
        return plant
    if not all(hasattr(plant, name) for name in (*names, "lift")):
        said = f"scales the drag of plant=simplified and its presets; plant={plant.name} has no such coefficients"
        raise UsageError(f"truth.drag={factor:g}: {said}")
    scaled = {name: tuple(factor * k for k in getattr(plant, name)) for name in names}
    return replace(plant, **scaled, lift=factor * plant.lift)


# ------------------------------------------------------------------------------------- trajectory, controller, remedies
def build_trajectory(config: Any, vehicle: Vehicle | None = None) -> Any:
    """The trajectory; raises UsageError or DataError where its numbers or its file describe none.

    vehicle: whose limits decide how fast a path is flown, for the kinds that follow them; they raise UsageError
    without it.
    """

    def make() -> Any:
        product = checked("trajectory", config, _with_file(config.anew()).build(vehicle))
        if not config.shipped:
            check_own(product, config.name)
        return product

    if not (config.shipped or config.follows_limits):
        return make()
    within = None if config.allow_infeasible or vehicle is None else vehicle.fingerprint
    # Its polynomials are costly, and the same for all.
    return cached(["trajectory", part_identity("trajectory", config), within], make)


def build_controller(config: Config, vehicle: Vehicle, plant: Any, model: ModelFile | None) -> Any:
    """The controller inside its remedies; one is kept for every (configuration, model), and begins anew with every
    flight."""
    controller = config.controller
    around = remedies(config)
    believed: Any = [part_identity("plant", config.plant), [*world_parts(config)]]
    if not controller.knows_plant:
        believed = model.sha256 if model else ""
    sensor_spec = sensor_spec_of(plant)
    parts = {"controller": controller, **around}
    identities = {group: part_identity(group, part) for group, part in parts.items()}
    record = ["controller", vehicle.fingerprint, identities, believed, asdict(sensor_spec)]

    context = BuildContext(
        vehicle=vehicle, plant=plant, sensor_spec=sensor_spec, remedies=tuple(around.values()),
        residual=lambda *kinds: build_residual(kinds, vehicle, plant, model),
        residuals=lambda kinds: residuals(kinds, vehicle, model),
        checkpoint=lambda index: load_checkpoint(vehicle, model.files[index]) if model else None,
        folder=model.path if model else "",
    )  # fmt: skip

    def make() -> Any:
        built = checked("controller", controller, controller.anew().build(context))
        try:
            for remedy in sorted(around.values(), key=lambda remedy: not remedy.alone):  # which refuses the others
                built = remedy.anew().put_around(built, context)
        except UsageError as error:
            raise UsageError(f"controller={controller.name}: {error}") from None
        return built

    return cached(record, make)


def sensor_spec_of(plant: Any) -> SensorSpec:
    """What is stated of the sensors of what is flown; without a world they are exact."""
    sensor_spec: SensorSpec | None = getattr(plant, "sensor_spec", None)
    exact = Stated() if sensor_spec is None and hasattr(plant, "rotor_speed") else None
    return SensorSpec(rotor_speed=exact) if sensor_spec is None else sensor_spec


def build_residual(kinds: tuple[str, ...], vehicle: Vehicle, plant: Any, model: ModelFile | None) -> Any:
    """What a controller believes of the air: nothing, the plant's own equations, or what checkpoints hold, summed."""
    if kinds == ("none",):
        from quadexp.models.residual import no_residual

        return no_residual(vehicle)
    if kinds == ("plant",):
        plant.reset()  # as things stand before any change in flight
        return plant.residual()
    from quadexp.models.residual import sum_residual

    return sum_residual(residuals(kinds, vehicle, model))


def check_remedies(config: Config, vehicle: Vehicle, plant: Any) -> None:
    """Raise UsageError where a compensation needs what neither vehicle nor world measure, nor the other parts know."""
    around = tuple(remedies(config).values())
    for remedy in [remedy for remedy in around if remedy.alone] or around:
        remedy.check(vehicle, plant, config.controller, around)


def checked(seam: str, part: Part, product: Any) -> Any:
    """What a part made; UsageError where it lacks what its seam asks for."""
    for old, new in ATTRIBUTES.get(seam, {}).items():
        if not hasattr(product, new) and hasattr(product, old):
            setattr(product, new, getattr(product, old))
    missing = [name for name in SEAMS[seam] if not hasattr(product, name)]
    if missing:
        said = f"made no {seam}, a {type(product).__name__} without {', '.join(missing)}"
        raise UsageError(f"{seam}._target_={part.class_path}: {said}")
    return product


# --------------------------------------------------------------------------------------------------------- checkpoints
def load_checkpoint(vehicle: Vehicle, model: ModelFile) -> Any:
    """The fitted model of a checkpoint. Raises DataError where it is of another vehicle, or has changed."""
    from quadexp.models.checkpoint import load_model

    if content_hash(Path(model.path) / MODEL_FILE) != model.sha256:
        raise DataError(f"{model.path}: has changed since this run began")
    return load_model(model.path, vehicle=vehicle)


def residuals(kinds: Iterable[str], vehicle: Vehicle, model: ModelFile | None) -> list[Any]:
    """The models of the air of some kinds, each from its own checkpoint."""

    def of_file(kind: str, file: ModelFile) -> Any:
        checkpoint = load_checkpoint(vehicle, file)
        checkpoint = checkpoint.linear_drag if kind == "linear_drag" else checkpoint
        if checkpoint.kind != kind:
            raise UsageError(f"{file.path}: holds {checkpoint.kind}, not {kind}, which {maker(kind)} makes")
        return replace(checkpoint.residual(vehicle, file.path), ranges=checkpoint.feature_range)

    files = zip((kind for kind in kinds if kind not in GIVEN), model.files if model else (), strict=False)
    record = ["residual", vehicle.fingerprint]
    return [cached([*record, kind, file.sha256], partial(of_file, kind, file)) for kind, file in files]


def model_residual(vehicle: Vehicle, path: Path, kind: str = "best") -> Any:
    """The residual of a checkpoint. kind: which model of an identified vehicle, "best" for its own choice.

    Raises UsageError where the checkpoint has none of that kind.
    """
    from quadexp.models.checkpoint import load_model

    return load_model(path, vehicle=vehicle, unknown=True).residual(vehicle, str(path), kind)
