"""From a configuration to its plant with the world around it."""

from __future__ import annotations

import hashlib
import importlib
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from quadexp.config.flight import PlantConfig, SimplifiedKeys
from quadexp.config.schema import Config, world_parts
from quadexp.config.settings import part
from quadexp.config.world import WorldPartConfig
from quadexp.errors import UsageError
from quadexp.experiment.build import build_plant, keep, plant_record
from quadexp.experiment.inputs import located
from quadexp.physics.vehicle import Vehicle


def build_world(config: Config, vehicle: Vehicle) -> Any:
    """The plant in its world; the plant itself where no part of the world does anything.

    vehicle: the one that controllers believe in.
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
    read = [hashlib.sha256(Path(one.path).read_bytes()).hexdigest() for one in effects if hasattr(one, "path")]
    given = {group: asdict(one) for group, one in parts.items()}
    record = ["world", plant_record(vehicle, config.plant), given, read]

    def make() -> Any:
        flown = _with_drag(config)
        same = true_vehicle is vehicle and flown is config.plant
        airframe = believed if same else build_plant(true_vehicle, flown, vehicle)
        if not isinstance(airframe, SimulatedPlant) or type(airframe).advance is not SimulatedPlant.advance:
            raise UsageError(
                f"{config.world}: needs a plant that is a SimulatedPlant (quadexp/world/integrator.py);"
                f" plant={config.plant.name} has an `advance` of its own, and flies without"
            )
        return World(airframe, effects, believed)

    return keep(record, make)


def build_effects(vehicle: Vehicle, *parts: WorldPartConfig) -> tuple[list[Any], Vehicle]:
    """The effects of parts of a world, and the vehicle that is flown in it.

    vehicle: the one that controllers believe in. Raises UsageError where a file is missing, or the flown vehicle could
    not hover.
    """
    effects = [_effect(one) for one in parts]
    for effect in effects:
        vehicle = effect.true_vehicle(vehicle)
    return effects, vehicle


def _check_one_lag(config: Config, plant: Any) -> None:
    """Raise UsageError where the plant's own lag and that of the actuator would act one after the other."""
    own = getattr(config.plant, "motor_lag", 0.0)
    if not max(config.actuator.time_constant_up, config.actuator.time_constant_down):
        return
    remedy = "the actuator's time constants to 0"
    if own:
        raise UsageError(
            f"plant.motor_lag={own:g} and actuator={config.actuator.name}: both let the rotors lag; set"
            f" plant.motor_lag=0, or {remedy}"
        )
    if lag := getattr(plant, "loop_lag", 0.0):
        raise UsageError(
            f"plant={config.plant.name} and actuator={config.actuator.name}: both let the rotors lag, the plant's own"
            f" motors by {1e3 * lag:.0f} ms; set {remedy} (actuator.time_constant_up=0 actuator.time_constant_down=0)"
        )


def _with_drag(config: Config) -> PlantConfig:
    """The plant with `truth.drag` times its drag and lift. Raises UsageError where it has none of these settings."""
    factor = getattr(config.truth, "drag", 1.0)
    if factor == 1.0:
        return config.plant
    if not isinstance(config.plant, SimplifiedKeys):
        raise UsageError(
            f"truth.drag={factor:g}: scales the drag of plant=simplified and its presets; plant={config.plant.name} has"
            " no such coefficients"
        )
    names = ("linear_drag", "quadratic_drag")
    scaled: dict[str, Any] = {name: tuple(factor * k for k in getattr(config.plant, name)) for name in names}
    plant: Any = config.plant
    flown: PlantConfig = replace(plant, **scaled, lift=factor * plant.lift)
    return flown


def _effect(config: WorldPartConfig) -> Any:
    module, _, name = config.effect.partition(":")
    copied = {"path": str(located(config.path))} if hasattr(config, "path") else {}
    return part(getattr(importlib.import_module(module), name), config, **copied)
