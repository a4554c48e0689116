"""Configuration nodes of the blade-element simulation (Lei & Li 2017): plant, sensor, trajectories, controllers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

from quadexp.config.fields import MISSING, Checked, choice, number
from quadexp.config.flight import ControllerConfig, MPCConfig, PlantConfig, TrajectoryConfig

FEEDBACK_VARIANTS = (
    "rls", "static", "literal", "nocomp_statid", "oracle", "oracle_impl", "rls_noH", "static_H",
)  # fmt: skip
CHANGES = ("t", "payload", "lift_scale", "profile_drag_scale")


@dataclass
class BladeElementPlantConfig(PlantConfig):
    """Lei & Li's plant; see quadexp/world/blade_element.py. schedule: changes in flight, each {t: s, payload: kg,
    lift_scale: [one factor a rotor], profile_drag_scale: factor}, all but t optional."""

    kind: str = "blade_element"
    method: str = choice("euler", "rk4")
    profile_drag: float = number("(0, 10]", "")
    lift_slope: float = number("(0, 20]", "1/rad")
    body_drag: list[float] = number("[0, 10]", "", length=3)
    printed_coefficients: bool = False
    rotor_local_velocity: bool = False
    motor_lag: float = number("[0, 1]", "s")
    rotor_speed_min: float = number("[0, 1000]", "rad/s")
    rotor_speed_max: float | None = number("(0, 1e5]", "rad/s")
    thrust_limits: bool = False
    payload: float = number("[0, 100]", "kg")
    schedule: Any = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__post_init__()
        for change in self.schedule if self.schedule != MISSING else ():
            unknown = sorted(set(change) - set(CHANGES)) if isinstance(change, dict) else [str(change)]
            if unknown or "t" not in change:
                found = f"unknown {unknown[0]!r}" if unknown else "no t"
                raise ValueError(f"plant.schedule: {found}; each change is {{t: s, {', '.join(CHANGES[1:])}}}")


@dataclass
class SensorConfig(Checked):
    """What the controller measures with: an accelerometer with bias and white noise; all else is perfect."""

    prefix: ClassVar[str] = "sensor."

    name: str = MISSING
    accelerometer_bias: list[float] = number("[-100, 100]", "m/s^2", length=3)
    accelerometer_noise: list[float] = number("[0, 100]", "m/s^2", length=3)


@dataclass
class RectangleConfig(TrajectoryConfig):
    """Lei & Li's Example 1; see quadexp/reference/rectangle.py."""

    kind: str = "rectangle"
    speed: float = number("(0, 60]", "m/s")
    duration: float = number("(0, 3600]", "s")
    height: float = number("(0, 1000]", "m")
    start: str = choice("printed", "reference")


@dataclass
class LeiLiCircleConfig(TrajectoryConfig):
    """Lei & Li's Example 2; see quadexp/reference/lei_li_circle.py."""

    kind: str = "lei_li_circle"
    radius: float = number("(0, 1000]", "m")
    slow_half: float = number("(0, 3600]", "s")
    duration: float = number("(0, 3600]", "s")
    height: float = number("(0, 1000]", "m")
    start: str = choice("printed", "reference")


@dataclass
class RLSConfig(Checked):
    """Identification in flight; see quadexp/learn/rls.py. profile_drag, lift_slope, body_drag: first values.
    relative_std: if given, P_0 is the square of relative_std times the first values, else covariance times identity.
    change_threshold: mean square prediction error, over that of the noise, at which P goes back to P_0."""

    prefix: ClassVar[str] = "controller.rls."

    profile_drag: float = number("(0, 10]", "")
    lift_slope: float = number("(0, 20]", "1/rad")
    body_drag: list[float] = number("[0, 10]", "", length=3)
    covariance: float = number("(0, 1e9]", "")
    relative_std: float | None = number("(0, 100]", "of the first values", None)
    noise: float = number("(0, 100]", "m/s^2")
    forgetting: float = number("[0.5, 1]", "")
    lift_weight: float = number("[0, 1]", "")
    gauss_newton: bool = False
    rotor_range: list[float] = number("(0, 100]", "of the first values", length=2)
    drag_range: list[float] = number("[0, 100]", "", length=2)
    clip: bool = True
    change_threshold: float | None = number("(1, 1e9]", "", None)


@dataclass
class RLSMPCConfig(MPCConfig):
    """MPC whose blade-element model is identified in flight; see quadexp/control/mpc/rls_mpc.py.
    reference_period: s, after which references are made anew from what is identified; 0: never."""

    kind: str = "rls_mpc"
    residual: str = choice("blade_element", default="blade_element")
    reference_period: float = number("[0, 3600]", "s")
    rls: RLSConfig = MISSING


@dataclass
class FeedbackConfig(ControllerConfig):
    """Compensated feedback; see quadexp/control/feedback/settings.py. variant: what is compensated, and from where."""

    kind: str = "feedback"
    variant: str = choice(*FEEDBACK_VARIANTS)
    backend: str = choice("auto", "compiled", "interpreted")
    rate: float = number("[1, 1000]", "Hz")
    position_proportional: list[float] = number("[0, 1000]", "1/s^2", length=3)
    position_derivative: list[float] = number("[0, 1000]", "1/s", length=3)
    attitude_proportional: list[float] = number("[0, 1000]", "1/s^2", length=3)
    attitude_derivative: list[float] = number("[0, 1000]", "1/s", length=3)
    observer_bandwidth: float = number("(0, 1000]", "rad/s")
    cone: bool = True
    thrust_share_min: float = number("(0, 1]", "of the weight")
    tilt_max: float = number("(0, 1.57]", "rad")
    rotor_speed_min: float = number("[0, 1000]", "rad/s")
    inner_iterations: int = number("[1, 1000]", "")
    rls: RLSConfig = MISSING
