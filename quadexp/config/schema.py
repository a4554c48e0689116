"""The typed configuration: every key, its type, unit and range.

The values live in conf/; here stands what they may be. An interval in a field's metadata is checked when the
configuration is made, so that a wrong value is refused before anything runs, in one line:

    trajectory.speed=-3: must be in (0, 60] m/s

Nothing heavy is imported here: worker processes and the command line both load this module.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar

from quadexp.config.custom import (
    CustomControllerConfig,
    CustomPlantConfig,
    CustomResidualMPCConfig,
    CustomTrajectoryConfig,
)
from quadexp.config.engine import DaskConfig, EngineConfig, SlurmConfig
from quadexp.config.fields import MISSING, Checked, choice, is_set, number
from quadexp.config.flight import (
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
from quadexp.config.lei_li import (
    BladeElementPlantConfig,
    FeedbackConfig,
    LeiLiCircleConfig,
    RectangleConfig,
    RLSMPCConfig,
    SensorConfig,
)
from quadexp.errors import UsageError


@dataclass
class CollectConfig(Checked):
    """How a data set is flown: flights of `flight_duration` until `duration` is reached, speeds spread evenly over
    [speed_min, speed_max]. mode: random (smooth random paths) or setpoints (jumps between random points).
    target, identified: of recorded flights; see quadexp/learn/recorded.py."""

    prefix: ClassVar[str] = "collect."

    mode: str = choice("random", "setpoints")
    duration: float = number("(0, 86400]", "s")
    flight_duration: float = number("[2, 3600]", "s")
    speed_min: float = number("(0, 60]", "m/s")
    speed_max: float = number("(0, 60]", "m/s")
    extent: float = number("(0, 1000]", "m")
    clearance: float = number("[-1000, 1000]", "m")
    frame: str = choice("midpoint", "start")
    target: str = choice("auto", "specific_force", "velocity", default="auto")
    identified: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if is_set(self.speed_min, self.speed_max) and self.speed_min > self.speed_max:
            raise ValueError(f"collect.speed_min={self.speed_min}: must not exceed collect.speed_max={self.speed_max}")


@dataclass
class GPFeatures(Checked):
    """For every output the features of its GP; an empty list leaves the output uncorrected."""

    prefix: ClassVar[str] = "gp.features."

    a_x: list[str] = field(default_factory=list)
    a_y: list[str] = field(default_factory=list)
    a_z: list[str] = field(default_factory=list)
    tau_x: list[str] = field(default_factory=list)
    tau_y: list[str] = field(default_factory=list)
    tau_z: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        allowed = re.compile(r"[vw]_[xyz]|u_\d+|thrust")
        for f in fields(self):
            for feature in getattr(self, f.name):
                if not allowed.fullmatch(feature):
                    raise ValueError(
                        f"{self.prefix}{f.name}: unknown feature {feature!r}; allowed are v_x v_y v_z w_x w_y w_z"
                        " thrust u_0 u_1 ..."
                    )


@dataclass
class GPConfig(Checked):
    """How the Gaussian processes are fitted; see quadexp/learn/gp_fit.py."""

    prefix: ClassVar[str] = "gp."

    features: GPFeatures = field(default_factory=GPFeatures)
    inducing: int = number("[2, 1000]", "points")
    method: str = choice("sgpr", "subset", "exact")
    mean: str = choice("zero", "constant", "linear_drag", "quadratic", "blade_element")
    split: str = choice("flight", "sample", default="flight")
    seed: int = number("[0, 4294967295]", "")
    max_rows: int | None = number("[10, 10000000]", "rows", None)
    max_exact_rows: int = number("[10, 100000]", "rows")
    holdout: float = number("[0, 0.9]", "of the flights")
    refit: bool = True
    max_iterations: int = number("[1, 10000]", "")
    jitter: float = number("(0, 1e-6]", "")


@dataclass
class DragConfig(Checked):
    """How linear drag is fitted; see quadexp/learn/linear_drag.py."""

    prefix: ClassVar[str] = "drag."

    intercept: bool = True
    thrust: bool = True
    errors: str = choice("flight", "hc1")
    loss: str = choice("huber", "squares")
    holdout: float = number("[0, 0.9]", "of the flights")
    seed: int = number("[0, 4294967295]", "")


@dataclass
class EvaluateConfig(Checked):
    """How a comparison is run and shown; nothing here changes a flight.

    metric: what the table shows. figures: which beside the standard ones.
    baseline: controller that the others are compared with. confidence: of intervals.
    workers: processes (0: one a core). timeout: of a flight (monotonic). memory: of its process (0: no limit).
    """

    prefix: ClassVar[str] = "evaluate."

    metric: str = choice("mean_error", "rmse", "max_error", default="mean_error")
    figures: str = choice("standard", "lei_li", "families", "adaptation", default="standard")
    baseline: str = "nominal_mpc"
    confidence: float = number("[0.5, 0.9999]", "", 0.95)
    workers: int = number("[0, 1024]", "processes", 0)
    timeout: float = number("(0, 86400]", "s", 600.0)
    memory: float = number("[0, 4096]", "GB", 4.0)


@dataclass
class Config(Checked):
    """The whole configuration. model: checkpoint folder. sweep: what `evaluate --sweep` varies (experiment files)."""

    vehicle: VehicleConfig = MISSING
    plant: PlantConfig = MISSING
    sensor: SensorConfig = MISSING
    trajectory: TrajectoryConfig = MISSING
    controller: ControllerConfig = MISSING
    collect: CollectConfig = MISSING
    gp: GPConfig = MISSING
    drag: DragConfig = MISSING
    engine: EngineConfig = MISSING
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    model: str | None = None
    seed: int = number("[0, 4294967295]", "", 0)
    sweep: Any = None


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
