"""From a configuration to the controllers that are no optimisation: control laws, and learned policies."""

from __future__ import annotations

import importlib
from typing import Any

from quadexp.config.dfbc import DFBCKeys
from quadexp.config.flight import ControllerConfig
from quadexp.config.laws import CascadeKeys, GeometricKeys, RaptorKeys, RotorPySE3Keys
from quadexp.config.settings import part
from quadexp.physics.vehicle import Vehicle

# Kind -> module of quadexp.control, class, and its settings: only the one that flies is imported.
LAWS = {
    "geometric": ("laws.geometric", "GeometricController", GeometricKeys),
    "cascade": ("laws.cascade", "CascadeController", CascadeKeys),
    "dfbc": ("dfbc.controller", "DFBC", DFBCKeys),
    "raptor": ("laws.raptor", "RaptorController", RaptorKeys),
    "rotorpy_se3": ("laws.rotorpy_se3", "RotorPySE3Controller", RotorPySE3Keys),
}


def law(vehicle: Vehicle, config: ControllerConfig, residual: Any) -> Any:
    """The controller. residual: its model of the air, None for a kind that takes none."""
    module, name, keys = LAWS[config.kind]
    given = [vehicle, part(keys, config)] + ([] if residual is None else [residual])
    backend = {"backend": config.backend} if hasattr(config, "backend") else {}
    return getattr(importlib.import_module(f"quadexp.control.{module}"), name)(*given, **backend)
