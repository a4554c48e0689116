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

    lift_slope: Annotated[
        float, Setting("lift slope C_la of the blades; in controller.rls the initial value", "(0, 20]", "1/rad")
    ]
    profile_drag: Annotated[
        float, Setting("profile drag C_d0 of the blades; in controller.rls the initial value", "(0, 10]")
    ]
    body_drag: Annotated[
        Triple, Setting("drag coefficients C_D of the airframe; in controller.rls the initial values", "[0, 10]")
    ]


@dataclass(frozen=True)
class BladeElementEffects(Settings):
    """What differs from the paper's plant, or the options it has."""

    prefix: ClassVar[str] = "plant."

    printed_coefficients: Annotated[
        bool, Setting("use the cross terms of equations (14) and (15) with their misprints, for comparison only")
    ] = False
    rotor_local_velocity: Annotated[
        bool, Setting("the air velocity at each rotor includes the body rates: v + w x r in place of v")
    ] = False
    motor_lag: Annotated[float, Setting("time constant of the rotor speeds; 0: no lag", "[0, 1]", "s")] = 0.0
    rotor_speed_min: Annotated[
        float,
        Setting(
            "idle speed of the rotors; with 0 they may stop, which the model can describe in still air only",
            "[0, 1000]",
            "rad/s",
        ),
    ] = 50.0
    rotor_speed_max: Annotated[
        float | None, Setting("largest speed of the rotors; null: no limit", "(0, 1e5]", "rad/s")
    ] = None
    thrust_limits: Annotated[bool, Setting("clip commands to the vehicle's thrust limits (the paper does not)")] = False
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
            "changes in flight, each {t: s, payload: kg, lift_scale: [a factor per rotor], profile_drag_scale: factor}"
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
        Triple, Setting("standard deviation of the white noise on the specific force", "[0, 100]", "m/s^2")
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

    covariance: Annotated[
        float, Setting("initial covariance P_0 as a multiple of the identity, where relative_std is null", "(0, 1e9]")
    ] = 50.0
    relative_std: Annotated[
        float | None,
        Setting(
            "standard deviation of the initial values, which gives P_0; null: see covariance",
            "(0, 100]",
            "of the initial values",
        ),
    ] = None
    noise: Annotated[float, Setting("assumed standard deviation of the accelerometer", "(0, 100]", "m/s^2")] = 1.0
    forgetting: Annotated[float, Setting("forgetting factor; 1 forgets nothing", "[0.5, 1]")] = 1.0
    lift_weight: Annotated[
        float,
        Setting("weight of the z axis in the combined estimate of C_la; x and y share the rest", "[0, 1]"),
    ] = 1.0
    gauss_newton: Annotated[bool, Setting("include the induced velocity in the derivative of the z equation")] = False
    rotor_range: Annotated[
        tuple[float, float],
        Setting("bounds of the estimates of C_d0 and C_la where they are used", "(0, 100]", "of the initial values"),
    ] = (0.5, 4.0)
    drag_range: Annotated[
        tuple[float, float], Setting("bounds of the estimate of C_D where it is used", "[0, 100]")
    ] = (0.0, 0.2)
    clip: Annotated[
        bool, Setting("clip the estimates to their bounds where they are used; clipped samples are counted")
    ] = True


@dataclass(frozen=True, kw_only=True)
class RLSConfig(RLSKeys, BladeKeys):
    """Identification in flight; see quadexp/learn/rls.py. profile_drag, lift_slope, body_drag: first values.
    relative_std: if given, P_0 is the square of relative_std times the first values, else covariance times identity.
    change_threshold: mean square prediction error, over that of the noise, at which P goes back to P_0."""

    change_threshold: Annotated[
        float | None,
        Setting(
            "ratio of the mean square prediction error to the noise variance at which P is reset to P_0; null: never",
            "(1, 1e9]",
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class RLSMPCConfig(PredictiveConfig):
    """MPC whose blade-element model is identified in flight; see quadexp/control/mpc/rls_mpc.py.
    reference_period: s between new references from the identified coefficients; 0: never."""

    kind: str = "rls_mpc"
    residual: Annotated[Literal["blade_element"], RESIDUAL] = "blade_element"
    reference_period: Annotated[
        float,
        Setting("time between new references from the identified coefficients; 0: never", "[0, 3600]", "s"),
    ]
    rls: Annotated[RLSConfig, Setting("recursive least squares in flight")]


@dataclass(frozen=True, kw_only=True)
class FeedbackKeys(Settings):
    """Gains, observer and safety options of compensated feedback, with the values of Lei & Li 2017; see
    quadexp/control/feedback/settings.py."""

    prefix: ClassVar[str] = "controller."

    rate: Annotated[float, Setting("control rate", "[1, 1000]", "Hz")] = 100.0
    position_proportional: Annotated[Triple, Setting("gain on the position error", "[0, 1000]", "1/s^2")] = (
        0.3,
        0.3,
        0.3,
    )
    position_derivative: Annotated[Triple, Setting("gain on the velocity error", "[0, 1000]", "1/s")] = (0.9, 0.9, 0.9)
    attitude_proportional: Annotated[Triple, Setting("gain on the error of the Euler angles", "[0, 1000]", "1/s^2")] = (
        0.8,
        0.8,
        0.8,
    )
    attitude_derivative: Annotated[Triple, Setting("gain on the error of the Euler rates", "[0, 1000]", "1/s")] = (
        2.4,
        2.4,
        2.4,
    )
    observer_bandwidth: Annotated[
        float,
        Setting(
            "bandwidth of the high-gain observer (36), which differentiates the desired angles", "(0, 1000]", "rad/s"
        ),
    ] = 6.0
    cone: Annotated[bool, Setting("limit the desired thrust by thrust_share_min and tilt_max (the paper does not)")] = (
        True
    )
    thrust_share_min: Annotated[
        float, Setting("least upward component of the desired thrust", "(0, 1]", "of the weight")
    ] = 0.3
    tilt_max: Annotated[float, Setting("largest tilt of the desired thrust", "(0, 1.57]", "rad")] = math.radians(60.0)
    rotor_speed_min: Annotated[float, Setting("least rotor speed that is commanded", "[0, 1000]", "rad/s")] = 50.0
    inner_iterations: Annotated[
        int, Setting("iterations of the fixed point, in variants that do not use the last sample's values", "[1, 1000]")
    ] = 50


@dataclass(frozen=True, kw_only=True)
class FeedbackConfig(FeedbackKeys, ControllerConfig):
    """Compensated feedback; see quadexp/control/feedback/settings.py. variant: what is compensated, and from where."""

    kind: str = "feedback"
    variant: Annotated[
        Literal["rls", "static", "literal", "nocomp_statid", "oracle", "oracle_impl", "rls_noH", "static_H"],
        Setting("what is compensated, and the source of the coefficients; see docs/lei_li.md"),
    ]
    backend: Backend = "auto"
    rls: Annotated[RLSConfig, Setting("recursive least squares in flight")]
