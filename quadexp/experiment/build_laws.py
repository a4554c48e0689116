"""From a configuration to the control laws in closed form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from quadexp.config.laws import GeometricConfig, GeometricKeys
from quadexp.config.settings import part
from quadexp.physics.vehicle import Vehicle


def geometric_controller(vehicle: Vehicle, config: GeometricConfig, residual: Any) -> Any:
    """Geometric tracking with a model of the air."""
    from quadexp.control.laws.geometric import GeometricController

    return GeometricController(vehicle, part(GeometricKeys, config), residual, backend=config.backend)


# Kind of controller -> (vehicle, its configuration, residual or None) -> controller.
MAKERS: dict[str, Callable[[Vehicle, Any, Any], Any]] = {
    "geometric": geometric_controller,
}
