"""From a checkpoint of recorded flights to the residual that it describes, for plants and controllers."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.experiment.inputs import located
from quadexp.physics.vehicle import Vehicle

MODEL_FILE = "model.json"
MAKER = "quadexp identify FLIGHT... --out models/NAME"


def model_hash(path: str) -> str:
    """Content hash of a checkpoint; UsageError where there is none."""
    file = located(path) / MODEL_FILE
    if not file.is_file():
        raise UsageError(f"plant.model={path}: no checkpoint there; make one: {MAKER}")
    return hashlib.sha256(file.read_bytes()).hexdigest()


def load_identified(path: str | Path, vehicle: Vehicle) -> Any:
    """A checkpoint for this vehicle; one of flights that do not say their vehicle is taken as it is.

    Raises UsageError where it was fitted for another vehicle.
    """
    from quadexp.learn.checkpoint import load_model

    model = load_model(located(path))
    if model.vehicle.get("fingerprint") not in (None, vehicle.fingerprint):
        raise UsageError(
            f"{path}: fitted for vehicle '{model.vehicle.get('name')}' ({model.vehicle.get('fingerprint')}), not for"
            f" '{vehicle.name}' ({vehicle.fingerprint}): pass the vehicle=... of its flights"
        )
    return model


def identified_plant(vehicle: Vehicle, config: Any, believed: Vehicle | None = None) -> Any:
    """The plant of plant=from_model. believed: the vehicle that its model was fitted for, None for the flown one."""
    from quadexp.world.from_model import FromModelPlant

    model_hash(config.model)
    return FromModelPlant(
        vehicle,
        model_residual(believed or vehicle, Path(config.model), config.residual),
        model_mass=believed.mass if believed else None,
        step=config.step,
        force_noise_density=config.force_noise_density,
        torque_noise_density=config.torque_noise_density,
        backend=config.backend,
    )


def model_residual(vehicle: Vehicle, path: Path, kind: str = "best") -> Any:
    """The residual of a checkpoint. kind: which model of an identified vehicle, "best" for its own choice.

    Raises UsageError where the checkpoint has none of that kind.
    """
    return load_identified(path, vehicle).residual(vehicle, str(path), kind)
