"""The whole configuration: every node, and the schemas that the files in conf/ extend.

What a key is stands with the settings (settings.py): flight.py, lei_li.py, custom.py, learning.py, engine.py. A file of
conf/ states only what differs from the defaults there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from quadexp.config.custom import (
    CustomControllerConfig,
    CustomPlantConfig,
    CustomResidualMPCConfig,
    CustomTrajectoryConfig,
)
from quadexp.config.engine import DaskConfig, EngineConfig, SlurmConfig
from quadexp.config.flight import (
    SEEDS,
    CircleConfig,
    ControllerConfig,
    FileConfig,
    FromModelPlantConfig,
    HoverConfig,
    LemniscateConfig,
    MPCConfig,
    PlantConfig,
    RandomConfig,
    SimplifiedPlantConfig,
    StepConfig,
    TrajectoryConfig,
    VehicleConfig,
)
from quadexp.config.learning import CollectConfig, DragConfig, GPConfig
from quadexp.config.lei_li import (
    BladeElementPlantConfig,
    FeedbackConfig,
    LeiLiCircleConfig,
    RectangleConfig,
    RLSMPCConfig,
    SensorConfig,
)
from quadexp.config.settings import Setting, Settings
from quadexp.errors import UsageError


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(Settings):
    """How a comparison is run and shown; nothing here changes a flight."""

    prefix: ClassVar[str] = "evaluate."

    metric: Annotated[
        Literal["mean_error", "rmse", "max_error"],
        Setting("what the table shows: mean ||e||, root mean square, or largest position error"),
    ] = "mean_error"
    figures: Annotated[
        Literal["standard", "lei_li", "families", "adaptation"],
        Setting("which figures are drawn beside the standard ones"),
    ] = "standard"
    baseline: Annotated[str, Setting("controller that the others are compared with, seed by seed")] = "nominal_mpc"
    confidence: Annotated[float, Setting("confidence level of every interval", "[0.5, 0.9999]")] = 0.95
    workers: Annotated[int, Setting("processes that fly at a time; 0: one a core", "[0, 1024]", "processes")] = 0
    timeout: Annotated[
        float, Setting("time (monotonic) after which a flight is given up, and tried once more", "(0, 86400]", "s")
    ] = 600.0
    memory: Annotated[float, Setting("what the process of a flight may take; 0: no limit", "[0, 4096]", "GB")] = 4.0


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    """The whole configuration. sweep: what `evaluate --sweep` varies (experiment files)."""

    vehicle: VehicleConfig
    plant: PlantConfig
    sensor: SensorConfig
    trajectory: TrajectoryConfig
    controller: ControllerConfig
    collect: CollectConfig
    gp: GPConfig
    drag: DragConfig
    engine: EngineConfig
    evaluate: Annotated[EvaluateConfig, Setting("how a comparison is run and shown")] = field(
        default_factory=EvaluateConfig
    )
    model: Annotated[
        str | None,
        Setting(
            "checkpoint folder for a controller that needs one; null: the first of controller.models that is there"
        ),
    ] = None
    seed: Annotated[
        int, Setting("draws the noise, and the path of trajectory=random; the same for every controller", SEEDS)
    ] = 0
    sweep: Any = None


SCHEMA = "_schema_"  # key of a node that names its schema

# Schemas by the name that conf/ files extend: `defaults: [/schema/trajectory/circle@_here_, _self_]`.
SCHEMAS: dict[str, dict[str, type]] = {
    "vehicle": {"rigid": VehicleConfig},
    "plant": {
        "simplified": SimplifiedPlantConfig,
        "from_model": FromModelPlantConfig,
        "blade_element": BladeElementPlantConfig,
        "custom": CustomPlantConfig,
    },
    "sensor": {"accelerometer": SensorConfig},
    "trajectory": {
        "circle": CircleConfig,
        "lemniscate": LemniscateConfig,
        "random": RandomConfig,
        "hover": HoverConfig,
        "step": StepConfig,
        "file": FileConfig,
        "rectangle": RectangleConfig,
        "lei_li_circle": LeiLiCircleConfig,
        "custom": CustomTrajectoryConfig,
    },
    "controller": {
        "mpc": MPCConfig,
        "feedback": FeedbackConfig,
        "rls_mpc": RLSMPCConfig,
        "custom": CustomControllerConfig,
        "custom_residual_mpc": CustomResidualMPCConfig,
    },
    "collect": {"flights": CollectConfig},
    "gp": {"sparse": GPConfig},
    "drag": {"linear": DragConfig},
    "engine": {"local": EngineConfig, "dask": DaskConfig, "slurm": SlurmConfig},
}

# Groups of presets, and the group whose values their options set (`# @package controller`).
PRESETS = {"horizon": "controller"}


def conf_folder() -> Path:
    """The configuration folder: beside the package when installed, above it in a checkout."""
    here = Path(__file__).resolve().parent.parent
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise UsageError(f"no conf/config.yaml beside {here}: the installation is incomplete")
