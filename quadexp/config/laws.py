"""Settings of the control laws in closed form: geometric tracking, a flight stack's cascade, laws of other programs.

Gains are bandwidths and rates, times the vehicle's own mass and inertia in the law, so that they hold for every
vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from quadexp.config.flight import RESIDUAL, Backend, ControllerConfig
from quadexp.config.settings import Setting, Settings, Triple

Rate = Annotated[float, Setting("control rate", "[1, 1000]", "Hz")]


@dataclass(frozen=True, kw_only=True)
class GeometricKeys(Settings):
    """Gains and options of geometric tracking; see quadexp/control/laws/geometric.py."""

    prefix: ClassVar[str] = "controller."

    rate: Rate = 100.0
    position_bandwidth: Annotated[
        Triple, Setting("w of the position loop, world axes: k_x = m w^2, k_v = 2 m damping w", "[0, 100]", "rad/s")
    ] = (4.0, 4.0, 4.0)
    position_damping: Annotated[float, Setting("damping ratio of the position loop", "[0, 10]")] = 0.9
    attitude_bandwidth: Annotated[
        Triple,
        Setting("w of roll, pitch and yaw: k_R = J w^2, k_w = 2 J damping w", "[0, 1000]", "rad/s"),
    ] = (14.0, 14.0, 6.0)
    attitude_damping: Annotated[float, Setting("damping ratio of the attitude loop", "[0, 10]")] = 0.9
    rates: Annotated[
        Literal["exact", "reference", "none"],
        Setting(
            "desired body rate and its derivative: exact: of the desired attitude, as Lee et al. have it; reference:"
            " those of the reference, without what feedback adds; none: zero"
        ),
    ] = "reference"
    priority: Annotated[
        Literal["tilt", "equal"],
        Setting("where rotors reach their limits: tilt before thrust before yaw, or each rotor clipped by itself"),
    ] = "tilt"
    force_adaptation: Annotated[
        float,
        Setting(
            "gain of the estimate of a constant acceleration (Goodarzi et al. 2015); 0: none", "[0, 1000]", "1/s^2"
        ),
    ] = 0.0
    torque_adaptation: Annotated[
        float,
        Setting("gain of the estimate of a constant angular acceleration; 0: none", "[0, 1e5]", "1/s^2"),
    ] = 0.0
    position_share: Annotated[
        float, Setting("c_1: share of the position error in the adaptation", "[0, 100]", "1/s")
    ] = 2.0
    attitude_share: Annotated[
        float, Setting("c_2: share of the attitude error in the adaptation", "[0, 1000]", "1/s")
    ] = 7.0
    force_limit: Annotated[float, Setting("largest acceleration that is adapted", "[0, 100]", "m/s^2")] = 5.0
    torque_limit: Annotated[float, Setting("largest angular acceleration that is adapted", "[0, 1e4]", "rad/s^2")] = (
        50.0
    )


@dataclass(frozen=True, kw_only=True)
class GeometricConfig(GeometricKeys, ControllerConfig):
    """Geometric tracking on SE(3) (Lee, Leok, McClamroch 2010). residual: its model of the air."""

    kind: str = "geometric"
    residual: Annotated[Literal["none", "linear_drag", "gaussian_process", "plant"], RESIDUAL] = "none"
    backend: Backend = "auto"


@dataclass(frozen=True, kw_only=True)
class CascadeKeys(Settings):
    """Gains and limits of a flight stack's cascade, PX4's defaults where they have a physical unit; see
    quadexp/control/laws/cascade.py."""

    prefix: ClassVar[str] = "controller."

    rate: Rate = 200.0
    position_proportional: Annotated[Triple, Setting("wanted velocity per position error", "[0, 100]", "1/s")] = (
        0.95,
        0.95,
        1.0,
    )
    velocity_proportional: Annotated[Triple, Setting("acceleration per velocity error", "[0, 100]", "1/s")] = (
        1.8,
        1.8,
        4.0,
    )
    velocity_integral: Annotated[Triple, Setting("rate of the integral per velocity error", "[0, 100]", "1/s^2")] = (
        0.4,
        0.4,
        2.0,
    )
    velocity_derivative: Annotated[Triple, Setting("acceleration per filtered acceleration", "[0, 10]")] = (
        0.2,
        0.2,
        0.0,
    )
    attitude_proportional: Annotated[
        Triple, Setting("wanted rate per attitude error: roll, pitch, yaw", "[0, 100]", "1/s")
    ] = (6.5, 6.5, 2.8)
    yaw_weight: Annotated[float, Setting("weight of yaw against tilt in the attitude error", "[0, 1]")] = 0.4
    rate_proportional: Annotated[
        Triple, Setting("angular acceleration per rate error: roll, pitch, yaw", "[0, 1000]", "1/s")
    ] = (20.0, 20.0, 8.0)
    rate_integral: Annotated[
        Triple, Setting("rate of the integral per rate error: roll, pitch, yaw", "[0, 10000]", "1/s^2")
    ] = (27.0, 27.0, 4.0)
    rate_derivative: Annotated[Triple, Setting("angular acceleration per filtered angular acceleration", "[0, 10]")] = (
        0.4,
        0.4,
        0.0,
    )
    velocity_cutoff: Annotated[float, Setting("cutoff of the filter on the acceleration", "(0, 1000]", "Hz")] = 5.0
    rate_cutoff: Annotated[float, Setting("cutoff of the filter on the angular acceleration", "(0, 1000]", "Hz")] = 30.0
    velocity_limit: Annotated[Triple, Setting("largest wanted velocity: horizontal, up, down", "(0, 100]", "m/s")] = (
        20.0,
        10.0,
        10.0,
    )
    tilt_limit: Annotated[float, Setting("largest wanted tilt", "(0, 1.57]", "rad")] = 1.4
    rate_limit: Annotated[Triple, Setting("largest wanted body rates", "(0, 100]", "rad/s")] = (10.0, 10.0, 5.0)
    thrust_least: Annotated[float, Setting("least wanted collective thrust", "(0, 1]", "of the weight")] = 0.2
    horizontal_margin: Annotated[
        float, Setting("thrust kept for the horizontal where the vertical needs all", "[0, 1]", "of the largest thrust")
    ] = 0.3
    decoupled: Annotated[
        bool, Setting("the tilt assumes a vertical specific force of g, so that the vertical does not change it")
    ] = True
    rate_integral_limit: Annotated[
        Triple, Setting("largest integral of the rate loop, angular acceleration", "[0, 1e4]", "rad/s^2")
    ] = (40.0, 40.0, 40.0)
    airmode: Annotated[bool, Setting("thrust may be raised where roll and pitch need it")] = False
    yaw_margin: Annotated[
        float, Setting("thrust that yaw may take away at the upper limit", "[0, 1]", "of the range")
    ] = 0.15
    rate_feedforward: Annotated[
        bool, Setting("add the reference's body rates to the wanted ones; flight stacks take none but the yaw rate")
    ] = False


@dataclass(frozen=True, kw_only=True)
class CascadeConfig(CascadeKeys, ControllerConfig):
    """The cascade of P and PID loops of a flight stack, fed with position, velocity, acceleration and yaw."""

    kind: str = "cascade"
    backend: Backend = "auto"


@dataclass(frozen=True, kw_only=True)
class RaptorKeys(Settings):
    """What the policy is shown; see quadexp/control/laws/raptor.py."""

    prefix: ClassVar[str] = "controller."

    rate: Annotated[float, Setting("control rate; the policy was trained at 100 Hz", "[1, 1000]", "Hz")] = 100.0
    position_limit: Annotated[
        float, Setting("largest position error that the policy is shown, each axis", "(0, 100]", "m")
    ] = 0.5
    velocity_limit: Annotated[
        float, Setting("largest velocity error that the policy is shown, each axis", "(0, 100]", "m/s")
    ] = 1.0


@dataclass(frozen=True, kw_only=True)
class RaptorConfig(RaptorKeys, ControllerConfig):
    """RAPTOR, a learned policy for all quadrotors (Eschmann et al. 2025), of the package foundation-policy."""

    kind: str = "raptor"
    backend: Backend = "auto"


@dataclass(frozen=True, kw_only=True)
class RotorPySE3Keys(Settings):
    """Gains of RotorPy's SE3 controller, its own defaults; see quadexp/control/laws/rotorpy_se3.py."""

    prefix: ClassVar[str] = "controller."

    rate: Rate = 100.0
    position_proportional: Annotated[Triple, Setting("kp_pos", "[0, 1000]", "1/s^2")] = (6.5, 6.5, 15.0)
    position_derivative: Annotated[Triple, Setting("kd_pos", "[0, 1000]", "1/s")] = (4.0, 4.0, 9.0)
    attitude_proportional: Annotated[float, Setting("kp_att", "[0, 1e5]", "1/s^2")] = 310.0
    attitude_derivative: Annotated[float, Setting("kd_att", "[0, 1e4]", "1/s")] = 57.0


@dataclass(frozen=True, kw_only=True)
class RotorPySE3Config(RotorPySE3Keys, ControllerConfig):
    """RotorPy's SE3Control (Folk, Paulos, Kumar 2023), the code of the package rotorpy itself."""

    kind: str = "rotorpy_se3"
