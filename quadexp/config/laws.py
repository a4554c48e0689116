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
    ] = "exact"
    priority: Annotated[
        Literal["tilt", "equal"],
        Setting("where rotors reach their limits: tilt before thrust before yaw, or each rotor clipped by itself"),
    ] = "tilt"
    force_adaptation: Annotated[
        float,
        Setting("gain of the estimate of a constant acceleration (Goodarzi et al. 2015); 0: none", "[0, 1000]", "1/s^2"),
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
    torque_limit: Annotated[float, Setting("largest angular acceleration that is adapted", "[0, 1e4]", "rad/s^2")] = 50.0


@dataclass(frozen=True, kw_only=True)
class GeometricConfig(GeometricKeys, ControllerConfig):
    """Geometric tracking on SE(3) (Lee, Leok, McClamroch 2010). residual: its model of the air."""

    kind: str = "geometric"
    residual: Annotated[Literal["none", "linear_drag", "gaussian_process", "plant"], RESIDUAL] = "none"
    backend: Backend = "auto"
