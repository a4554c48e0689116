"""The nodes of the configuration that decide a flight: vehicle, plant, sensor, trajectory, controller.

See quadexp/config/schema.py for how values are checked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

from quadexp.config.fields import MISSING, Checked, choice, number


# --------------------------------------------------------------------------------------------------------- vehicle
@dataclass
class RotorConfig(Checked):
    """Shape of every rotor, and the air; see quadexp/physics/rotor.py."""

    prefix: ClassVar[str] = "vehicle.rotor."

    radius: float = number("[0.001, 10]", "m")
    chord: float = number("(0, 1]", "m")
    twist: float = number("(0, 1.57]", "rad")
    air_density: float = number("(0, 10]", "kg/m^3")
    reference_area: float = number("(0, 100]", "m^2")
    blades: int = number("[1, 20]", "", 2)


@dataclass
class VehicleConfig(Checked):
    """Physical parameters of a multirotor; see quadexp/physics/vehicle.py."""

    prefix: ClassVar[str] = "vehicle."

    name: str = MISSING
    mass: float = number("(0, 100]", "kg")
    inertia: Any = MISSING  # (3, 3), body frame, kg m^2
    rotor_position: Any = MISSING  # (n, 3), body frame, m
    rotor_spin: list[float] = number("[-1, 1]", "")  # (n,), sign of the reaction torque about +z_body
    torque_coefficient: float = number("[0, 1]", "m")
    thrust_min: float = number("[0, 1000]", "N per rotor")
    thrust_max: float = number("(0, 1000]", "N per rotor")
    rate_max: float = number("(0, 100]", "rad/s")
    gravity: float = number("(0, 100]", "m/s^2", 9.81)
    rotor: RotorConfig | None = None
    static_thrust: float | None = number("(0, 1]", "N s^2", None)

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
    right = all(len(row) == 3 and all(map(math.isfinite, row)) for row in made)
    if not made or not right or (n is not None and len(made) != n):
        raise ValueError(f"{key}={str(rows).replace(' ', '')}: must be {n or 'some'} rows of 3 numbers each")
    return made


# ----------------------------------------------------------------------------------------------------------- plant
@dataclass
class PlantConfig(Checked):
    """What every plant has. kind: which plant of quadexp/world/ (set by the schema)."""

    prefix: ClassVar[str] = "plant."

    name: str = MISSING
    kind: str = MISSING
    step: float = number("[1e-5, 0.02]", "s")
    backend: str = choice("auto", "compiled", "interpreted")


@dataclass
class SimplifiedPlantConfig(PlantConfig):
    """Torrente's simplified simulation; see quadexp/world/simplified.py."""

    kind: str = "simplified"
    linear_drag: list[float] = number("[0, 100]", "N s/m", length=3)
    quadratic_drag: list[float] = number("[0, 100]", "N s^2/m^2", length=3)
    motor_loss: float = number("[0, 1)", "")
    motor_noise_density: float = number("[0, 1]", "1/sqrt(Hz)")
    force_noise_density: float = number("[0, 10]", "N/sqrt(Hz)")
    torque_noise_density: float = number("[0, 10]", "N m/sqrt(Hz)")
    payload: float = number("[0, 100]", "kg")


@dataclass
class FromModelPlantConfig(PlantConfig):
    """A model identified from flights as the truth; see quadexp/world/from_model.py. model: its checkpoint folder."""

    kind: str = "from_model"
    model: str = MISSING
    residual: str = choice("best", "linear", "quadratic", "blade_element", "gaussian_process", default="best")
    force_noise_density: float = number("[0, 10]", "N/sqrt(Hz)", 0.0)
    torque_noise_density: float = number("[0, 10]", "N m/sqrt(Hz)", 0.0)


# ------------------------------------------------------------------------------------------------------ trajectory
@dataclass
class TrajectoryConfig(Checked):
    """What every trajectory has. kind: which one of quadexp/reference/ (set by the schema).

    allow_infeasible: fly a reference although it asks for more than the vehicle has.
    lost_distance: further than this from the reference (m) a flight is over.
    """

    prefix: ClassVar[str] = "trajectory."

    name: str = MISSING
    kind: str = MISSING
    allow_infeasible: bool = False
    lost_distance: float = number("(0, 1e6]", "m", 10.0)


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
    """A smooth random path through a few keypoints, as fast as `speed` and the vehicle's limits allow."""

    kind: str = "random"
    speed: float = number("(0, 60]", "m/s")
    margin: float = number("[0, 0.9]", "")
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
    """A sampled track from a CSV (t, p_x, p_y, p_z, optionally yaw) or TUM file, or minimum-snap polynomials through
    the waypoints of a CSV (x, y, z, optionally t and yaw; 2 are enough)."""

    kind: str = "file"
    path: str = MISSING
    speed: float | None = number("(0, 60]", "m/s", None)
    margin: float = number("[0, 0.9]", "")


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
    """Model predictive control; see quadexp/control/mpc/settings.py. residual: what it believes of the air."""

    kind: str = "mpc"
    residual: str = choice("none", "linear_drag", "gaussian_process", "plant")
    backend: str = choice("auto", "compiled", "interpreted")
    horizon: float = number("(0, 10]", "s")
    nodes: int = number("[2, 200]", "nodes")
    first_node: float = number("[0, 10]", "s", 0.0)
    dead_time: float = number("[0, 0.5]", "s", 0.0)
    motor_lag: float = number("[0, 0.5]", "s", 0.0)
    rate: float = number("[1, 1000]", "Hz")
    position_weight: list[float] = number("[0, 1e6]", "", length=3)
    attitude_weight: list[float] = number("[0, 1e6]", "", length=4)
    attitude_error: str = choice("plain", "body")
    velocity_weight: list[float] = number("[0, 1e6]", "", length=3)
    rate_weight: list[float] = number("[0, 1e6]", "", length=3)
    input_weight: float = number("(0, 1e6]", "")
    terminal_weight: float = number("[0, 1e6]", "")
    feedforward: bool = True
    initial_iterations: int = number("[1, 1000]", "")
    distance_limit: float = number("(0, 1e6]", "m", 10.0)
