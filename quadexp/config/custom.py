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
from typing import Annotated, Any, Literal

from quadexp.config.flight import RESIDUAL, SPEED, ControllerConfig, PlantConfig, PredictiveConfig, TrajectoryConfig
from quadexp.config.settings import Setting, Settings


@dataclass(frozen=True, kw_only=True)
class CustomKeys(Settings):
    """What is called, and with what."""

    _target_: Annotated[str, Setting("MODULE.NAME of your class or function, called with the arguments above")]
    options: Annotated[dict[str, Any], Setting("its keyword arguments")] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class CustomPlantConfig(CustomKeys, PlantConfig):
    """Your plant: _target_(vehicle, step=..., **options) -> Plant; step: s, of its integration."""

    kind: str = "custom"


@dataclass(frozen=True, kw_only=True)
class CustomTrajectoryConfig(CustomKeys, TrajectoryConfig):
    """Your trajectory: _target_(**options) -> Trajectory; called with speed too, where it is set."""

    kind: str = "custom"
    speed: Annotated[float | None, SPEED] = None


@dataclass(frozen=True, kw_only=True)
class CustomControllerConfig(CustomKeys, ControllerConfig):
    """Your controller: _target_(vehicle, **options) -> Controller."""

    kind: str = "custom"


@dataclass(frozen=True, kw_only=True)
class CustomResidualMPCConfig(CustomKeys, PredictiveConfig):
    """The MPC with your residual: _target_(vehicle, **options) -> Residual."""

    residual: Annotated[Literal["custom"], RESIDUAL] = "custom"
