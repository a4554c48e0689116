"""The whole configuration: every node, and the schemas that the files in conf/ extend.

What a key is stands with the settings (settings.py): flight.py, lei_li.py, foreign.py, custom.py, learning.py,
engine.py. A file of conf/ states only what differs from the defaults there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from quadexp.config.adaptive import L1Config
from quadexp.config.airframe import (
    DisturbanceConfig,
    FixedPayloadConfig,
    GroundConfig,
    SlungLoadConfig,
    TruthConfig,
)
from quadexp.config.custom import (
    CustomControllerConfig,
    CustomPlantConfig,
    CustomResidualMPCConfig,
    CustomTrajectoryConfig,
)
from quadexp.config.delays import IdentifiedDelayConfig, PredictionConfig, StrapdownConfig
from quadexp.config.dfbc import DFBCConfig
from quadexp.config.engine import DaskConfig, EngineConfig, JobsConfig
from quadexp.config.flight import (
    SEEDS,
    CircleConfig,
    ControllerConfig,
    EllipseConfig,
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
from quadexp.config.foreign import DroneModelsPlantConfig, RotorPyPlantConfig
from quadexp.config.inner import INDIConfig
from quadexp.config.laws import CascadeConfig, GeometricConfig, RaptorConfig, RotorPySE3Config
from quadexp.config.learned import OnlineMPCConfig, SumMPCConfig
from quadexp.config.learning import CollectConfig, DragConfig, GPConfig, NNConfig
from quadexp.config.lei_li import (
    BladeElementPlantConfig,
    FeedbackConfig,
    LeiLiCircleConfig,
    RectangleConfig,
    RLSMPCConfig,
    SensorConfig,
)
from quadexp.config.motors import ActuatorConfig, BatteryConfig, RotorLossConfig
from quadexp.config.observers import DisturbanceObserverConfig, WindObserverConfig
from quadexp.config.remedies import RemedyConfig
from quadexp.config.sensing import EskfConfig, ImuGnssConfig, ImuMocapConfig
from quadexp.config.settings import Setting, Settings
from quadexp.config.wind import DrydenConfig, GustConfig, WindFileConfig
from quadexp.config.world import ConstantWindConfig, LatencyConfig, StatedEstimateConfig, WorldPartConfig
from quadexp.errors import UsageError


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(Settings):
    """How a comparison is run and shown; nothing here changes a flight."""

    prefix: ClassVar[str] = "evaluate."

    metric: Annotated[
        Literal["mean_error", "rmse", "max_error"],
        Setting("error in the table: mean, root mean square, or largest distance from the reference"),
    ] = "mean_error"
    figures: Annotated[
        Literal["standard", "lei_li", "families", "adaptation", "ladder", "sun"],
        Setting("figures drawn in addition to the standard ones"),
    ] = "standard"
    baseline: Annotated[str, Setting("controller with which the others are compared, seed by seed")] = "nominal_mpc"
    confidence: Annotated[float, Setting("confidence level of every interval", "[0.5, 0.9999]")] = 0.95
    workers: Annotated[int, Setting("parallel processes; 0: one per core", "[0, 1024]", "processes")] = 0
    timeout: Annotated[
        float, Setting("time limit of a flight (wall time), after which it is tried once more", "(0, 86400]", "s")
    ] = 600.0
    memory: Annotated[float, Setting("memory limit of the process of a flight; 0: no limit", "[0, 4096]", "GB")] = 4.0
    log_period: Annotated[
        float,
        Setting(
            "time between the samples of a flight that are stored; 0: every control instant. Figures of the table are"
            " computed before",
            "[0, 3600]",
            "s",
        ),
    ] = 0.0


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    """The whole configuration. sweep: what `evaluate --sweep` varies (experiment files). world: the name of what is
    around the plant, for tables; see `world_name`."""

    vehicle: VehicleConfig
    plant: PlantConfig
    truth: WorldPartConfig
    payload: WorldPartConfig
    wind: WorldPartConfig
    external: WorldPartConfig
    link: WorldPartConfig
    actuator: ActuatorConfig
    battery: WorldPartConfig
    health: RotorLossConfig
    ground: WorldPartConfig
    sensor: WorldPartConfig
    estimator: WorldPartConfig
    trajectory: TrajectoryConfig
    controller: ControllerConfig
    observer: RemedyConfig
    adaptive: RemedyConfig
    inner: RemedyConfig
    delay: RemedyConfig
    collect: CollectConfig
    gp: GPConfig
    drag: DragConfig
    nn: NNConfig
    engine: EngineConfig
    evaluate: Annotated[EvaluateConfig, Setting("how a comparison is run and shown")] = field(
        default_factory=EvaluateConfig
    )
    model: Annotated[
        str | None,
        Setting(
            "checkpoint folder for a controller that needs one; null: the first folder of controller.models that exists"
        ),
    ] = None
    seed: Annotated[
        int, Setting("seed of the noise and of the path of trajectory=random; the same for every controller", SEEDS)
    ] = 0
    world: str = ""
    sweep: Any = None


SCHEMA = "_schema_"  # key of a node that names its schema

# Schemas by the name that conf/ files extend: `defaults: [/schema/trajectory/circle@_here_, _self_]`.
SCHEMAS: dict[str, dict[str, type]] = {
    "vehicle": {"rigid": VehicleConfig},
    "plant": {
        "simplified": SimplifiedPlantConfig,
        "from_model": FromModelPlantConfig,
        "blade_element": BladeElementPlantConfig,
        "rotorpy": RotorPyPlantConfig,
        "drone_models": DroneModelsPlantConfig,
        "custom": CustomPlantConfig,
    },
    "truth": {"nominal": TruthConfig},
    "payload": {"none": WorldPartConfig, "fixed": FixedPayloadConfig, "slung": SlungLoadConfig},
    "wind": {
        "none": WorldPartConfig,
        "constant": ConstantWindConfig,
        "gust": GustConfig,
        "dryden": DrydenConfig,
        "file": WindFileConfig,
    },
    "external": {"none": WorldPartConfig, "push": DisturbanceConfig},
    "link": {"ideal": WorldPartConfig, "latency": LatencyConfig},
    "actuator": {"motors": ActuatorConfig},
    "battery": {"none": WorldPartConfig, "circuit": BatteryConfig},
    "health": {"rotor_loss": RotorLossConfig},
    "ground": {"none": WorldPartConfig, "cheeseman_bennett": GroundConfig},
    "sensor": {"accelerometer": SensorConfig, "imu_mocap": ImuMocapConfig, "imu_gnss": ImuGnssConfig},
    "estimator": {"none": StatedEstimateConfig, "eskf": EskfConfig},
    "trajectory": {
        "circle": CircleConfig,
        "ellipse": EllipseConfig,
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
        "dfbc": DFBCConfig,
        "rls_mpc": RLSMPCConfig,
        "sum_mpc": SumMPCConfig,
        "online_mpc": OnlineMPCConfig,
        "geometric": GeometricConfig,
        "cascade": CascadeConfig,
        "raptor": RaptorConfig,
        "rotorpy_se3": RotorPySE3Config,
        "custom": CustomControllerConfig,
        "custom_residual_mpc": CustomResidualMPCConfig,
    },
    "observer": {
        "none": RemedyConfig,
        "disturbance": DisturbanceObserverConfig,
        "wind": WindObserverConfig,
    },
    "adaptive": {"none": RemedyConfig, "l1": L1Config},
    "inner": {"none": RemedyConfig, "indi": INDIConfig},
    "delay": {
        "none": RemedyConfig,
        "strapdown": StrapdownConfig,
        "prediction": PredictionConfig,
        "identified": IdentifiedDelayConfig,
    },
    "collect": {"flights": CollectConfig},
    "gp": {"sparse": GPConfig},
    "drag": {"linear": DragConfig},
    "nn": {"mlp": NNConfig},
    "engine": {"local": EngineConfig, "dask": DaskConfig, "jobs": JobsConfig},
}

# Groups of the world around an airframe, in the order in which a command meets them; see quadexp/world/effect.py.
WORLD = (
    "truth",
    "payload",
    "wind",
    "external",
    "link",
    "actuator",
    "battery",
    "health",
    "ground",
    "sensor",
    "estimator",
)

# Groups of remedies around a controller, the one nearest to it first; see quadexp/control/wrapped.py.
REMEDIES = ("observer", "adaptive", "inner", "delay")

# Groups whose options choose those of several others, and set values of theirs.
BUNDLES = {"world": WORLD, "remedies": REMEDIES}

# Groups of presets, and the group whose values their options set (`# @package controller`).
PRESETS = {"horizon": "controller", "motor": "controller"}


def remedies(config: Config) -> dict[str, RemedyConfig]:
    """The remedies that do something, by group, the one nearest to the controller first."""
    parts = {group: getattr(config, group) for group in REMEDIES}
    return {group: one for group, one in parts.items() if not one.idle}


def controller_name(config: Config) -> str:
    """What the controller is called in tables, with the remedies around it: "gp_mpc+wind+strapdown"."""
    return "+".join([config.controller.name, *(one.name for one in remedies(config).values())])


def world_parts(config: Config) -> dict[str, WorldPartConfig]:
    """The parts of the world that do something, by group; a sensor that is only an accelerometer is none."""
    parts = {group: getattr(config, group) for group in WORLD}
    return {group: one for group, one in parts.items() if one.effect and not one.idle}


def world_name(config: Config, bundle: str, bundled: Mapping[str, Any]) -> str:
    """What the world is called, without blanks: "clean", or a bundle and the parts that differ from it, as in
    "outdoor_breeze,wind=none" and "wind=constant,link=latency".

    bundle: option of the group `world`. bundled: the parts that it chooses, by group.
    """
    if not world_parts(config):
        return "clean"
    own = [f"{group}={getattr(config, group).name}" for group in WORLD if getattr(config, group) != bundled[group]]
    return ",".join(own if bundle == "clean" else [bundle, *own])


def conf_folder() -> Path:
    """The configuration folder: beside the package when installed, above it in a checkout."""
    here = Path(__file__).resolve().parent.parent
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise UsageError(f"no conf/config.yaml beside {here}: the installation is incomplete")
