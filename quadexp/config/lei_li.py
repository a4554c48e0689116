"""Settings of the blade-element simulation (Lei & Li 2017): plant, sensor, trajectories, feedback, identification."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from quadexp.config.flight import (
    DURATION,
    PAYLOAD,
    RADIUS,
    RESIDUAL,
    SPEED,
    Backend,
    ControllerConfig,
    PathKeys,
    PlantConfig,
    PredictiveConfig,
    TrajectoryConfig,
)
from quadexp.config.settings import Setting, Settings, Triple
from quadexp.config.world import WorldPartConfig
from quadexp.errors import UsageError

HEIGHT = Setting("height of the path, world", "(0, 1000]", "m")
Start = Annotated[
    Literal["printed", "reference"],
    Setting("where the flight starts: as printed in the paper, or on the reference"),
]


# ----------------------------------------------------------------------------------------------------------- plant
@dataclass(frozen=True)
class BladeKeys(Settings):
    """Aerodynamic coefficients of rotors and airframe; see quadexp/physics/rotor.py."""

    lift_slope: Annotated[float, Setting("C_la of the blades; controller.rls: its first value", "(0, 20]", "1/rad")]
    profile_drag: Annotated[float, Setting("C_d0 of the blades; controller.rls: its first value", "(0, 10]")]
    body_drag: Annotated[Triple, Setting("C_D of the airframe; controller.rls: its first value", "[0, 10]")]


@dataclass(frozen=True)
class BladeElementEffects(Settings):
    """What differs from the paper's plant, or the options it has."""

    prefix: ClassVar[str] = "plant."

    printed_coefficients: Annotated[
        bool, Setting("the misprinted cross terms of (14) and (15), for comparison only")
    ] = False
    rotor_local_velocity: Annotated[bool, Setting("every rotor meets v + w x r, not v")] = False
    motor_lag: Annotated[float, Setting("time constant of the rotor speeds; 0: none", "[0, 1]", "s")] = 0.0
    rotor_speed_min: Annotated[
        float,
        Setting(
            "idle speed of the rotors; with 0 they may stop, which the model allows in still air only",
            "[0, 1000]",
            "rad/s",
        ),
    ] = 50.0
    rotor_speed_max: Annotated[
        float | None, Setting("largest speed of the rotors; null: none", "(0, 1e5]", "rad/s")
    ] = None
    thrust_limits: Annotated[bool, Setting("clip commands to the vehicle's limits; the paper has none")] = False
    payload: Annotated[float, PAYLOAD] = 0.0


CHANGES = ("payload", "lift_scale", "profile_drag_scale")


@dataclass(frozen=True, kw_only=True)
class BladeElementPlantConfig(BladeElementEffects, BladeKeys, PlantConfig):
    """Lei & Li's plant; see quadexp/world/blade_element.py. schedule: changes in flight, each {t: s, payload: kg,
    lift_scale: [one factor a rotor], profile_drag_scale: factor}, all but t optional."""

    kind: str = "blade_element"
    method: Annotated[
        Literal["euler", "rk4"], Setting("explicit Euler as in Lei & Li 2017, or Runge-Kutta of fourth order")
    ]
    schedule: Annotated[
        tuple[Any, ...],
        Setting(
            "changes in flight: {t: s, payload: kg, lift_scale: [a factor per rotor], profile_drag_scale: factor} each"
        ),
    ] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for change in self.schedule:
            unknown = sorted({*change} - {"t", *CHANGES}) if isinstance(change, Mapping) else [str(change)]
            if unknown or "t" not in change:
                found = f"unknown {unknown[0]!r}" if unknown else "no t"
                raise UsageError(f"plant.schedule: {found}; each change is {{t: s, {', '.join(CHANGES)}}}")


@dataclass(frozen=True, kw_only=True)
class SensorConfig(WorldPartConfig):
    """What the controller measures with: an accelerometer with bias and white noise; all else is perfect."""

    prefix: ClassVar[str] = "sensor."

    accelerometer_bias: Annotated[Triple, Setting("constant error of the specific force", "[-100, 100]", "m/s^2")] = (
        0.0,
        0.0,
        0.0,
    )
    accelerometer_noise: Annotated[
        Triple, Setting("standard deviation of the specific force, white", "[0, 100]", "m/s^2")
    ] = (0.0, 0.0, 0.0)


# ------------------------------------------------------------------------------------------------------ trajectory
@dataclass(frozen=True, kw_only=True)
class RectangleKeys(PathKeys):
    """A square at constant speed."""

    speed: Annotated[float, SPEED] = 5.0
    duration: Annotated[float, DURATION] = 60.0
    height: Annotated[float, HEIGHT] = 5.0
    start: Start = "printed"


@dataclass(frozen=True, kw_only=True)
class RectangleConfig(RectangleKeys, TrajectoryConfig):
    """Lei & Li's Example 1; see quadexp/reference/rectangle.py."""

    kind: str = "rectangle"


@dataclass(frozen=True, kw_only=True)
class LeiLiCircleKeys(PathKeys):
    """A circle with two speeds."""

    radius: Annotated[float, RADIUS] = 28.0
    slow_half: Annotated[float, Setting("duration of the slow half of a lap", "(0, 3600]", "s")] = 20.0
    duration: Annotated[float, DURATION] = 60.0
    height: Annotated[float, HEIGHT] = 5.0
    start: Start = "printed"


@dataclass(frozen=True, kw_only=True)
class LeiLiCircleConfig(LeiLiCircleKeys, TrajectoryConfig):
    """Lei & Li's Example 2; see quadexp/reference/lei_li_circle.py."""

    kind: str = "lei_li_circle"


# ------------------------------------------------------------------------------------------------------ controller
@dataclass(frozen=True)
class RLSKeys(Settings):
    """How the estimators are started and weighted; the defaults are the paper's, with clipping."""

    prefix: ClassVar[str] = "controller.rls."

    covariance: Annotated[float, Setting("P_0 is this times the identity, where relative_std is null", "(0, 1e9]")] = (
        50.0
    )
    relative_std: Annotated[
        float | None,
        Setting(
            "P_0 is the square of this times the first values; null: see covariance", "(0, 100]", "of the first values"
        ),
    ] = None
    noise: Annotated[float, Setting("assumed standard deviation of the accelerometer", "(0, 100]", "m/s^2")] = 1.0
    forgetting: Annotated[float, Setting("forgetting factor; 1 forgets nothing", "[0.5, 1]")] = 1.0
    lift_weight: Annotated[
        float,
        Setting("share of the z axis in the combined estimate of C_la, the rest is that of x and y", "[0, 1]"),
    ] = 1.0
    gauss_newton: Annotated[bool, Setting("differentiate the z equation through the induced velocity")] = False
    rotor_range: Annotated[
        tuple[float, float], Setting("bounds of C_d0 and C_la in use", "(0, 100]", "of the first values")
    ] = (0.5, 4.0)
    drag_range: Annotated[tuple[float, float], Setting("bounds of C_D in use", "[0, 100]")] = (0.0, 0.2)
    clip: Annotated[bool, Setting("keep the values in use within their bounds; counted")] = True


@dataclass(frozen=True, kw_only=True)
class RLSConfig(RLSKeys, BladeKeys):
    """Identification in flight; see quadexp/learn/rls.py. profile_drag, lift_slope, body_drag: first values.
    relative_std: if given, P_0 is the square of relative_std times the first values, else covariance times identity.
    change_threshold: mean square prediction error, over that of the noise, at which P goes back to P_0."""

    change_threshold: Annotated[
        float | None,
        Setting("mean square prediction error, over the noise's, at which P goes back to P_0; null: never", "(1, 1e9]"),
    ] = None


@dataclass(frozen=True, kw_only=True)
class RLSMPCConfig(PredictiveConfig):
    """MPC whose blade-element model is identified in flight; see quadexp/control/mpc/rls_mpc.py.
    reference_period: s, after which references are made anew from what is identified; 0: never."""

    kind: str = "rls_mpc"
    residual: Annotated[Literal["blade_element"], RESIDUAL] = "blade_element"
    reference_period: Annotated[
        float,
        Setting("time after which references are made anew from what is identified; 0: never", "[0, 3600]", "s"),
    ]
    rls: Annotated[RLSConfig, Setting("identification in flight")]


@dataclass(frozen=True, kw_only=True)
class FeedbackKeys(Settings):
    """Gains, observer and safety options of compensated feedback, with the values of Lei & Li 2017; see
    quadexp/control/feedback/settings.py."""

    prefix: ClassVar[str] = "controller."

    rate: Annotated[float, Setting("control steps a second", "[1, 1000]", "Hz")] = 100.0
    position_proportional: Annotated[Triple, Setting("gain on the position error", "[0, 1000]", "1/s^2")] = (
        0.3,
        0.3,
        0.3,
    )
    position_derivative: Annotated[Triple, Setting("gain on the velocity error", "[0, 1000]", "1/s")] = (0.9, 0.9, 0.9)
    attitude_proportional: Annotated[Triple, Setting("gain on the Euler angles' error", "[0, 1000]", "1/s^2")] = (
        0.8,
        0.8,
        0.8,
    )
    attitude_derivative: Annotated[Triple, Setting("gain on the Euler rates' error", "[0, 1000]", "1/s")] = (
        2.4,
        2.4,
        2.4,
    )
    observer_bandwidth: Annotated[
        float, Setting("of the high-gain observer (36) of the desired angles' derivatives", "(0, 1000]", "rad/s")
    ] = 6.0
    cone: Annotated[
        bool, Setting("keep the desired thrust within thrust_share_min and tilt_max; the paper does not")
    ] = True
    thrust_share_min: Annotated[float, Setting("least upward demand of the cone", "(0, 1]", "of the weight")] = 0.3
    tilt_max: Annotated[float, Setting("largest tilt of the cone", "(0, 1.57]", "rad")] = math.radians(60.0)
    rotor_speed_min: Annotated[float, Setting("least speed that is commanded", "[0, 1000]", "rad/s")] = 50.0
    inner_iterations: Annotated[
        int, Setting("of the fixed point, where a variant has no delay of one sample", "[1, 1000]")
    ] = 50


@dataclass(frozen=True, kw_only=True)
class FeedbackConfig(FeedbackKeys, ControllerConfig):
    """Compensated feedback; see quadexp/control/feedback/settings.py. variant: what is compensated, and from where."""

    kind: str = "feedback"
    variant: Annotated[
        Literal["rls", "static", "literal", "nocomp_statid", "oracle", "oracle_impl", "rls_noH", "static_H"],
        Setting("what is compensated and where its coefficients come from; see docs/lei_li.md"),
    ]
    backend: Backend = "auto"
    rls: Annotated[RLSConfig, Setting("identification in flight")]
