"""Settings of flatness-based control with a constrained allocation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from quadexp.config.flight import RESIDUAL, Backend, ControllerConfig
from quadexp.config.settings import Setting, Settings, Triple

WRENCH_WEIGHT = Setting(
    "weight of the squared error of collective thrust (N^-2) and of roll, pitch, yaw torque ((N m)^-2) where the rotors"
    " cannot give all of them",
    "(0, 1e6]",
)
Wrench = tuple[float, float, float, float]
TILT_FIRST: Wrench = (0.001, 10.0, 10.0, 0.1)  # of Sun et al. 2022


@dataclass(frozen=True, kw_only=True)
class DFBCKeys(Settings):
    """Gains with the values of Sun et al. 2022, Table I; see quadexp/control/dfbc/law.py."""

    prefix: ClassVar[str] = "controller."

    rate: Annotated[float, Setting("control rate", "[1, 2000]", "Hz")] = 300.0
    position_gain: Annotated[Triple, Setting("acceleration per position error, world axes", "[0, 1e4]", "1/s^2")] = (
        10.0,
        10.0,
        10.0,
    )
    velocity_gain: Annotated[Triple, Setting("acceleration per velocity error, world axes", "[0, 1e4]", "1/s")] = (
        6.0,
        6.0,
        6.0,
    )
    tilt_gain: Annotated[float, Setting("angular acceleration per tilt error", "[0, 1e5]", "1/s^2")] = 150.0
    yaw_gain: Annotated[float, Setting("angular acceleration per yaw error", "[0, 1e5]", "1/s^2")] = 3.0
    rate_gain: Annotated[Triple, Setting("angular acceleration per body rate error", "[0, 1e4]", "1/s")] = (
        20.0,
        20.0,
        8.0,
    )
    wrench_weight: Annotated[Wrench, WRENCH_WEIGHT] = TILT_FIRST
    allocation: Annotated[
        Literal["exact", "clip"],
        Setting("exact: thrusts of the least weighted error within the limits; clip: each clipped by itself"),
    ] = "exact"
    inverted: Annotated[
        Literal["continuous", "printed"],
        Setting(
            "upside down, continuous: the side of y_body that is nearer to the present one; printed: turned by 180"
            " degrees where the rotors' axis passes the horizon"
        ),
    ] = "continuous"
    least_thrust: Annotated[
        float,
        Setting("thrust, as a share of the weight, below which body rates are fed forward as at this one", "(0, 1]"),
    ] = 0.07


@dataclass(frozen=True, kw_only=True)
class DFBCConfig(DFBCKeys, ControllerConfig):
    """Flatness-based control (Sun et al. 2022). residual: its model of the air."""

    kind: str = "dfbc"
    backend: Backend = "auto"
    residual: Annotated[Literal["none", "linear_drag", "gaussian_process", "plant"], RESIDUAL] = "none"
