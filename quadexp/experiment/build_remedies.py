"""From a configuration to the remedies around its controller."""

from __future__ import annotations

import importlib
from typing import Any

from quadexp.config.delays import IdentifiedDelayConfig
from quadexp.config.observers import DisturbanceObserverConfig
from quadexp.config.schema import Config, remedies
from quadexp.errors import UsageError
from quadexp.physics.vehicle import Vehicle


def check_needs(config: Config, vehicle: Vehicle, plant: Any) -> None:
    """UsageError where a remedy of a configuration needs what neither this vehicle nor its world measures.

    A scale of the thrust or of the air is the ratio of two forces at one time. Where motors lag, the thrusts of that
    time are known from rotor speeds, or from a lag and a dead time that are told or found.
    """
    lag = getattr(plant, "loop_lag", 0.0)
    parts, keys = (config.observer, config.controller), ("motor_lag", "dead_time")
    told = [getattr(part, key, None) for part in parts for key in keys]
    if not isinstance(config.observer, DisturbanceObserverConfig) or vehicle.thrust_coefficient is not None:
        return
    if lag and not any(told) and not isinstance(config.delay, IdentifiedDelayConfig):
        for key in ("scale_walk", "air_walk"):
            if getattr(config.observer, key) > 0:
                raise UsageError(
                    f"observer.{key}: a scale is found from rotor speeds, which need vehicle.thrust_coefficient, and"
                    f" vehicle={config.vehicle.name} has none; its motors lag by {1e3 * lag:.0f} ms here: give the"
                    f" coefficient, or observer.motor_lag and observer.dead_time, or observer.{key}=0"
                )


def with_remedies(controller: Any, config: Config) -> Any:
    """The controller inside the remedies of a configuration; the controller itself where there are none.

    Raises UsageError where a remedy cannot be put around this controller, with what it needs.
    """
    for part in remedies(config).values():
        module, _, name = part.remedy.partition(":")
        try:
            controller = getattr(importlib.import_module(module), name)(controller, part)
        except UsageError as error:
            raise UsageError(f"controller={config.controller.name}: {error}") from None
    return controller
