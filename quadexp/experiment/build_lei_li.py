"""From a configuration to what belongs to Lei & Li's system: blade-element plant, feedback, the identifying MPC."""

from __future__ import annotations

from typing import Any

from quadexp.config.lei_li import BladeElementEffects, BladeElementPlantConfig, FeedbackConfig, RLSConfig, RLSMPCConfig
from quadexp.config.settings import part
from quadexp.errors import UsageError
from quadexp.physics.vehicle import Vehicle


def blade_element_plant(vehicle: Vehicle, config: BladeElementPlantConfig) -> Any:
    """The blade-element plant; UsageError where the vehicle has no rotors of known shape."""
    from quadexp.physics.rotor import BladeCoefficients
    from quadexp.world.blade_element import BladeElementPlant, PlantChange

    if vehicle.rotor is None:
        raise UsageError(
            f"plant={config.name}: vehicle={vehicle.name} has no vehicle.rotor (its rotors' shape); vehicle=lei_li has"
        )
    changes = []
    for change in config.schedule:
        given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in change.items()}
        changes.append(PlantChange(**given))
    return BladeElementPlant(
        vehicle,
        part(BladeCoefficients, config),
        part(BladeElementEffects, config),
        step=config.step,
        method=config.method,
        schedule=changes,
        backend=config.backend,
    )


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

    estimator = BladeElementRLS(vehicle, part(BladeCoefficients, config), part(RLSSettings, config), backend=backend)
    return IdentifiedCoefficients(estimator, config.change_threshold)
