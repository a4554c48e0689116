"""From a configuration to what belongs to Lei & Li's system: blade-element plant, feedback, the identifying MPC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from quadexp.config.lei_li import BladeElementPlantConfig, FeedbackConfig, RLSConfig, RLSMPCConfig
from quadexp.errors import UsageError
from quadexp.physics.vehicle import Vehicle


def blade_element_plant(vehicle: Vehicle, config: BladeElementPlantConfig) -> Any:
    """The blade-element plant; UsageError where the vehicle has no rotors of known shape."""
    from quadexp.physics.rotor import BladeCoefficients
    from quadexp.world.blade_element import BladeElementEffects, BladeElementPlant, PlantChange

    if vehicle.rotor is None:
        raise UsageError(
            f"plant={config.name}: vehicle={vehicle.name} has no vehicle.rotor (its rotors' shape); vehicle=lei_li has"
        )
    values = {
        f.name: getattr(config, f.name) for f in fields(BladeElementEffects) if getattr(config, f.name) is not None
    }
    changes = []
    for change in config.schedule:
        given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in change.items()}
        changes.append(PlantChange(**given))
    return BladeElementPlant(
        vehicle,
        BladeCoefficients(config.lift_slope, config.profile_drag, _three(config.body_drag)),
        BladeElementEffects(**values),
        step=config.step,
        method=config.method,
        schedule=changes,
        backend=config.backend,
    )


def _three(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def feedback_settings() -> type:
    """The class of a feedback controller's settings."""
    from quadexp.control.feedback.settings import FeedbackSettings

    return FeedbackSettings


def variant(config: FeedbackConfig) -> Any:
    """What a feedback configuration compensates."""
    from quadexp.control.feedback.settings import VARIANTS

    return VARIANTS[config.variant]


def feedback_controller(config: FeedbackConfig, settings: Any, vehicle: Vehicle, plant: Any) -> Any:
    """The feedback controller; UsageError where it is to know coefficients that the plant does not have."""
    import numpy as np

    from quadexp.control.feedback.aerodynamics import KnownCoefficients
    from quadexp.control.feedback.controller import FeedbackController

    chosen = variant(config)
    if chosen.parameters == "none":
        aerodynamics: Any = KnownCoefficients(np.zeros(5), "the vehicle's thrust map")
    elif chosen.parameters == "identified":
        aerodynamics = identification(config.rls, vehicle, config.backend)
    elif hasattr(plant, "coefficients"):
        aerodynamics = KnownCoefficients(plant.coefficients.parameters(), "plant equations")
    else:
        raise UsageError(f"{config.name}: knows the plant's blade-element coefficients; plant=blade_element has them")
    return FeedbackController(vehicle, settings, chosen, aerodynamics, backend=config.backend)


def identifying_mpc(config: RLSMPCConfig, settings: Any, vehicle: Vehicle) -> Any:
    """The MPC with an identified blade-element model."""
    from quadexp.air.blade_element import blade_element_residual
    from quadexp.control.mpc.mpc import ModelPredictiveController
    from quadexp.control.mpc.rls_mpc import IdentifyingController

    identified = identification(config.rls, vehicle, config.backend)
    residual = blade_element_residual(vehicle, identified.estimator.initial, identified.source)
    mpc = ModelPredictiveController(vehicle, residual, settings, backend=config.backend)
    return IdentifyingController(mpc, identified, config.reference_period)


def identification(config: RLSConfig, vehicle: Vehicle, backend: str) -> Any:
    """Coefficients identified in flight, as configured."""
    from quadexp.control.feedback.aerodynamics import IdentifiedCoefficients
    from quadexp.learn.rls import BladeElementRLS, RLSSettings
    from quadexp.physics.rotor import BladeCoefficients

    first = BladeCoefficients(config.lift_slope, config.profile_drag, _three(config.body_drag))
    values = {f.name: getattr(config, f.name) for f in fields(RLSSettings) if hasattr(config, f.name)}
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    estimator = BladeElementRLS(vehicle, first, RLSSettings(**values), backend=backend)
    return IdentifiedCoefficients(estimator, config.change_threshold)
