"""From a configuration to the control laws in closed form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from quadexp.config.laws import (
    CascadeConfig,
    CascadeKeys,
    GeometricConfig,
    GeometricKeys,
    RaptorConfig,
    RaptorKeys,
    RotorPySE3Config,
    RotorPySE3Keys,
)
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


def raptor_controller(vehicle: Vehicle, config: RaptorConfig, residual: Any) -> Any:
    """The learned policy RAPTOR."""
    from quadexp.control.laws.raptor import RaptorController

    return RaptorController(vehicle, part(RaptorKeys, config), backend=config.backend)


def rotorpy_se3_controller(vehicle: Vehicle, config: RotorPySE3Config, residual: Any) -> Any:
    """RotorPy's SE3 controller."""
    from quadexp.control.laws.rotorpy_se3 import RotorPySE3Controller

    return RotorPySE3Controller(vehicle, part(RotorPySE3Keys, config))


# Kind of controller -> (vehicle, its configuration, residual or None) -> controller.
MAKERS: dict[str, Callable[[Vehicle, Any, Any], Any]] = {
    "geometric": geometric_controller,
    "cascade": cascade_controller,
    "raptor": raptor_controller,
    "rotorpy_se3": rotorpy_se3_controller,
}
