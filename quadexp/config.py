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

from quadexp.errors import UsageError
from quadexp.fields import MISSING, Checked, choice, number


# --------------------------------------------------------------------------------------------------------- vehicle
@dataclass
class VehicleConfig(Checked):
    """Physical parameters of a multirotor; see quadexp/vehicle.py."""

    prefix: ClassVar[str] = "vehicle."

    name: str = MISSING
    mass: float = number("(0, 100]", "kg")
    inertia: Any = MISSING  # (3, 3), body frame, kg m^2
    rotor_position: Any = MISSING  # (n, 3), body frame, m
    rotor_spin: list[float] = MISSING  # type: ignore[assignment]  # (n,), sign of the reaction torque about +z_body
    torque_coefficient: float = number("[0, 1]", "m")
    thrust_min: float = number("[0, 1000]", "N per rotor")
    thrust_max: float = number("(0, 1000]", "N per rotor")
    rate_max: float = number("(0, 100]", "rad/s")
    gravity: float = number("(0, 100]", "m/s^2", 9.81)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.inertia = _rows("vehicle.inertia", self.inertia, n=3)
        self.rotor_position = _rows("vehicle.rotor_position", self.rotor_position)


def _rows(key: str, rows: Any, n: int | None = None) -> Any:
    """Rows of three numbers each, as floats."""
    try:
        made = [[float(item) for item in row] for row in rows]
    except (TypeError, ValueError):
        made = []
    if not made or any(len(row) != 3 for row in made) or (n is not None and len(made) != n):
        raise ValueError(f"{key}={str(rows).replace(' ', '')}: must be {n or 'some'} rows of 3 numbers each")
    return made


# ----------------------------------------------------------------------------------------------------------- plant
@dataclass
class PlantConfig(Checked):
    """What every plant has. kind: which plant of quadexp/plant/ (set by the schema)."""

    prefix: ClassVar[str] = "plant."

    name: str = MISSING
    kind: str = MISSING
    step: float = number("(0, 0.02]", "s")
    backend: str = choice("auto", "compiled", "interpreted")


@dataclass
class SimplifiedPlantConfig(PlantConfig):
    """Torrente's simplified simulation; see quadexp/plant/simplified.py."""

    kind: str = "simplified"
    linear_drag: list[float] = number("[0, 100]", "N s/m", length=3)
    quadratic_drag: list[float] = number("[0, 100]", "N s^2/m^2", length=3)
    motor_loss: float = number("[0, 1)", "")
    motor_noise_density: float = number("[0, 1]", "1/sqrt(Hz)")
    force_noise_density: float = number("[0, 10]", "N/sqrt(Hz)")
    torque_noise_density: float = number("[0, 10]", "N m/sqrt(Hz)")
    payload: float = number("[0, 100]", "kg")


# ------------------------------------------------------------------------------------------------------ trajectory
@dataclass
class TrajectoryConfig(Checked):
    """What every trajectory has. kind: which one of quadexp/trajectory/ (set by the schema).

    allow_infeasible: fly a reference although it asks for more than the vehicle has.
    """

    prefix: ClassVar[str] = "trajectory."

    name: str = MISSING
    kind: str = MISSING
    allow_infeasible: bool = False


@dataclass
class CircleConfig(TrajectoryConfig):
    """A circle, started and ended at rest; speed is the nominal (cruising) speed."""

    kind: str = "circle"
    speed: float = number("(0, 60]", "m/s")
    acceleration: float = number("(0, 50]", "m/s^2")
    radius: float = number("(0, 1000]", "m")
    height: float = number("[-1000, 1000]", "m")


@dataclass
class LemniscateConfig(CircleConfig):
    """A lemniscate (r cos th, r sin th cos th), started and ended at rest."""

    kind: str = "lemniscate"


@dataclass
class RandomConfig(TrajectoryConfig):
    """A smooth random path through a few keypoints; speed = mean keypoint distance / segment time."""

    kind: str = "random"
    speed: float = number("(0, 60]", "m/s")
    seed: int = number("[0, 4294967295]", "")
    keypoints: int = number("[4, 200]", "points")
    extent: float = number("(0, 1000]", "m")
    clearance: float = number("[-1000, 1000]", "m")


@dataclass
class HoverConfig(TrajectoryConfig):
    """Staying at a point."""

    kind: str = "hover"
    position: list[float] = number("[-1e6, 1e6]", "m", length=3)
    yaw: float = number("[-7, 7]", "rad")
    duration: float = number("(0, 3600]", "s")


@dataclass
class StepConfig(TrajectoryConfig):
    """A jump of the set-point."""

    kind: str = "step"
    start: list[float] = number("[-1e6, 1e6]", "m", length=3)
    target: list[float] = number("[-1e6, 1e6]", "m", length=3)
    step_time: float = number("[0, 3600]", "s")
    duration: float = number("(0, 3600]", "s")


@dataclass
class FileConfig(TrajectoryConfig):
    """A trajectory from a CSV or TUM file."""

    kind: str = "file"
    path: str = MISSING


# ------------------------------------------------------------------------------------------------------ controller
@dataclass
class ControllerConfig(Checked):
    """What every controller has. models: where to look for a checkpoint when `model` is not given, in this order."""

    prefix: ClassVar[str] = "controller."

    name: str = MISSING
    kind: str = MISSING
    models: list[str] = field(default_factory=list)


@dataclass
class MPCConfig(ControllerConfig):
    """Model predictive control; see quadexp/control/settings.py. residual: what it believes of the air."""

    kind: str = "mpc"
    residual: str = choice("none", "linear_drag", "gaussian_process", "plant")
    backend: str = choice("auto", "compiled", "interpreted")
    horizon: float = number("(0, 10]", "s")
    nodes: int = number("[2, 200]", "nodes")
    rate: float = number("[1, 1000]", "Hz")
    position_weight: list[float] = number("[0, 1e6]", "", length=3)
    attitude_weight: list[float] = number("[0, 1e6]", "", length=4)
    velocity_weight: list[float] = number("[0, 1e6]", "", length=3)
    rate_weight: list[float] = number("[0, 1e6]", "", length=3)
    input_weight: float = number("(0, 1e6]", "")
    terminal_weight: float = number("[0, 1e6]", "")
    feedforward: bool = True
    initial_iterations: int = number("[1, 1000]", "")
    max_sweeps: int = number("[1, 1000]", "")


# ----------------------------------------------------------------------------------------- collect, gp, drag, evaluate
@dataclass
class CollectConfig(Checked):
    """How a data set is flown: flights of `flight_duration` until `duration` is reached, speeds spread evenly over
    [speed_min, speed_max]. mode: random (smooth random paths) or setpoints (jumps between random points)."""

    prefix: ClassVar[str] = "collect."

    mode: str = choice("random", "setpoints")
    duration: float = number("(0, 86400]", "s")
    flight_duration: float = number("[2, 3600]", "s")
    speed_min: float = number("(0, 60]", "m/s")
    speed_max: float = number("(0, 60]", "m/s")
    extent: float = number("(0, 1000]", "m")
    clearance: float = number("[-1000, 1000]", "m")
    frame: str = choice("midpoint", "start")

    def __post_init__(self) -> None:
        super().__post_init__()
        if MISSING not in (self.speed_min, self.speed_max) and self.speed_min > self.speed_max:
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
    """How the Gaussian processes are fitted; see quadexp/identify/gp_fit.py."""

    prefix: ClassVar[str] = "gp."

    features: GPFeatures = field(default_factory=GPFeatures)
    inducing: int = number("[2, 1000]", "points")
    method: str = choice("sgpr", "subset", "exact")
    mean: str = choice("zero", "constant", "linear_drag")
    seed: int = number("[0, 4294967295]", "")
    max_rows: int | None = number("[10, 10000000]", "rows", None)
    max_exact_rows: int = number("[10, 100000]", "rows")
    holdout: float = number("[0, 0.9]", "of the flights")
    refit: bool = True
    max_iterations: int = number("[1, 10000]", "")
    jitter: float = number("(0, 1e-6]", "")


@dataclass
class DragConfig(Checked):
    """How linear drag is fitted; see quadexp/identify/linear_drag.py."""

    prefix: ClassVar[str] = "drag."

    intercept: bool = True
    thrust: bool = True
    errors: str = choice("hc1", "flight")
    holdout: float = number("[0, 0.9]", "of the flights")
    seed: int = number("[0, 4294967295]", "")


@dataclass
class EvaluateConfig(Checked):
    """How a comparison is run and shown; nothing here changes a flight.

    metric: what the table shows. workers: processes (0: one a core). timeout: wall time a flight may take.
    """

    prefix: ClassVar[str] = "evaluate."

    metric: str = choice("mean_error", "rmse", "max_error", default="mean_error")
    workers: int = number("[0, 1024]", "processes", 0)
    timeout: float = number("(0, 86400]", "s", 600.0)


@dataclass
class Config(Checked):
    """The whole configuration. model: checkpoint folder. sweep: what `evaluate --sweep` varies (experiment files)."""

    vehicle: VehicleConfig = MISSING  # type: ignore[assignment]
    plant: PlantConfig = MISSING  # type: ignore[assignment]
    trajectory: TrajectoryConfig = MISSING  # type: ignore[assignment]
    controller: ControllerConfig = MISSING  # type: ignore[assignment]
    collect: CollectConfig = MISSING  # type: ignore[assignment]
    gp: GPConfig = MISSING  # type: ignore[assignment]
    drag: DragConfig = MISSING  # type: ignore[assignment]
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    model: str | None = None
    seed: int = number("[0, 4294967295]", "", 0)
    sweep: Any = None


# Schemas by the name that conf/ files extend: `defaults: [/schema/trajectory/circle@_here_, _self_]`.
SCHEMAS: dict[str, dict[str, type]] = {
    "vehicle": {"rigid": VehicleConfig},
    "plant": {"simplified": SimplifiedPlantConfig},
    "trajectory": {
        "circle": CircleConfig,
        "lemniscate": LemniscateConfig,
        "random": RandomConfig,
        "hover": HoverConfig,
        "step": StepConfig,
        "file": FileConfig,
    },
    "controller": {"mpc": MPCConfig},
    "collect": {"flights": CollectConfig},
    "gp": {"sparse": GPConfig},
    "drag": {"linear": DragConfig},
}


def conf_folder() -> Path:
    """The configuration folder: beside the package when installed, above it in a checkout."""
    here = Path(__file__).resolve().parent
    for folder in (here / "conf", here.parent / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise UsageError(f"no conf/config.yaml beside {here}: the installation is incomplete")
