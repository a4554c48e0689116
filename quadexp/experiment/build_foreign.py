"""From a configuration to the plants that have the equations of other programs."""

from __future__ import annotations

from typing import Any

from quadexp.config.foreign import DroneModelsKeys, DroneModelsPlantConfig, RotorPyKeys, RotorPyPlantConfig
from quadexp.config.settings import part
from quadexp.physics.vehicle import Vehicle


def rotorpy_plant(vehicle: Vehicle, config: RotorPyPlantConfig) -> Any:
    """The plant of plant=rotorpy."""
    from quadexp.world.rotorpy import RotorPyPlant

    return RotorPyPlant(vehicle, part(RotorPyKeys, config), step=config.step, backend=config.backend)


def drone_models_plant(vehicle: Vehicle, config: DroneModelsPlantConfig) -> Any:
    """The plant of plant=drone_models."""
    from quadexp.world.drone_models import DroneModelsPlant

    return DroneModelsPlant(vehicle, part(DroneModelsKeys, config), step=config.step, backend=config.backend)
