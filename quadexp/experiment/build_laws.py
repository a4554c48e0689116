"""From a configuration to the control laws in closed form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from quadexp.config.laws import CascadeConfig, CascadeKeys, GeometricConfig, GeometricKeys
from quadexp.config.settings import part
from quadexp.physics.vehicle import Vehicle


def geometric_controller(vehicle: Vehicle, config: GeometricConfig, residual: Any) -> Any:
    """Geometric tracking with a model of the air."""
    from quadexp.control.laws.geometric import GeometricController

    return GeometricController(vehicle, part(GeometricKeys, config), residual, backend=config.backend)


def cascade_controller(vehicle: Vehicle, config: CascadeConfig, residual: Any) -> Any:
    """A flight stack's cascade."""
    from quadexp.control.laws.cascade import CascadeController

    return CascadeController(vehicle, part(CascadeKeys, config), backend=config.backend)


# Kind of controller -> (vehicle, its configuration, residual or None) -> controller.
MAKERS: dict[str, Callable[[Vehicle, Any, Any], Any]] = {
    "geometric": geometric_controller,
    "cascade": cascade_controller,
}
