"""Nodes of the configuration that name a class or function of the user's own.

A configuration file says where it is found and what it is given:

    defaults: [/schema/trajectory/custom@_here_, _self_]
    name: helix
    _target_: my_package.helix.Helix
    options: {radius: 3.0, pitch: 0.5}

`_target_` is imported and called; it can only name what stands in the --conf folder or in an installed plugin package,
see quadexp/config/plugins.py and, for what is called with what, quadexp/experiment/build_custom.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from quadexp.config.fields import MISSING, choice, number
from quadexp.config.flight import ControllerConfig, MPCConfig, PlantConfig, TrajectoryConfig


@dataclass
class CustomPlantConfig(PlantConfig):
    """A plant of one's own: _target_(vehicle, step=..., **options) -> Plant; step: s, of its integrator."""

    kind: str = "custom"
    step: float = number("[1e-5, 0.02]", "s", 1e-3)
    backend: str = choice("auto", "compiled", "interpreted", default="auto")
    _target_: str = MISSING
    options: dict[str, Any] = field(default_factory=dict)


@dataclass
class CustomTrajectoryConfig(TrajectoryConfig):
    """A trajectory of one's own: _target_(**options) -> Trajectory; speed, where it is set, is passed on too."""

    kind: str = "custom"
    speed: float | None = number("(0, 60]", "m/s", None)
    _target_: str = MISSING
    options: dict[str, Any] = field(default_factory=dict)


@dataclass
class CustomControllerConfig(ControllerConfig):
    """A controller of one's own: _target_(vehicle, **options) -> Controller."""

    kind: str = "custom"
    _target_: str = MISSING
    options: dict[str, Any] = field(default_factory=dict)


@dataclass
class CustomResidualMPCConfig(MPCConfig):
    """The MPC with a residual of one's own: _target_(vehicle, **options) -> Residual."""

    residual: str = choice("custom", default="custom")
    _target_: str = MISSING
    options: dict[str, Any] = field(default_factory=dict)
