"""Settings of inner loops: what turns the thrusts of a controller into those of the rotors, at a rate of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from quadexp.config.dfbc import TILT_FIRST, WRENCH_WEIGHT, Wrench
from quadexp.config.flight import Backend
from quadexp.config.remedies import RemedyConfig
from quadexp.config.settings import Setting, Settings


@dataclass(frozen=True, kw_only=True)
class INDIKeys(Settings):
    """Incremental nonlinear dynamic inversion with the values of Sun et al. 2022; see quadexp/control/indi/law.py."""

    prefix: ClassVar[str] = "inner."

    rate: Annotated[
        float, Setting("rate of the loop, a whole multiple of the controller's rate", "[1, 10000]", "Hz")
    ] = 300.0
    cutoff: Annotated[
        float,
        Setting(
            "cut-off of the Butterworth filter of body rates and rotor speeds, below half the rate", "(0, 5000]", "Hz"
        ),
    ] = 12.0
    allocation: Annotated[
        Literal["clip", "exact"],
        Setting("clip: each thrust clipped by itself; exact: the least weighted error within the limits"),
    ] = "clip"
    wrench_weight: Annotated[Wrench, WRENCH_WEIGHT] = TILT_FIRST
    rotor_inertia: Annotated[
        float,
        Setting(
            "of a rotor and motor about its axis, whose acceleration turns the vehicle; 0: neglected; needs"
            " vehicle.thrust_coefficient",
            "[0, 1]",
            "kg m^2",
        ),
    ] = 0.0
    spin_up_time: Annotated[
        float,
        Setting(
            "time in which a rotor is thought to reach its command, for rotor_inertia: its time constant (Tal and"
            " Karaman 2021); 0: one period of the loop, as Sun et al. 2022 print it",
            "[0, 1]",
            "s",
        ),
    ] = 0.03
    motor_lag: Annotated[
        float, Setting("time constant of the thrusts, where rotor speeds are not measured", "[0, 1]", "s")
    ] = 0.0
    dead_time: Annotated[
        float, Setting("delay of the commands, where rotor speeds are not measured", "[0, 0.5]", "s")
    ] = 0.0


@dataclass(frozen=True, kw_only=True)
class INDIConfig(INDIKeys, RemedyConfig):
    """An INDI rate loop; see quadexp/control/indi."""

    remedy = "quadexp.control.indi.loop:with_indi"
    backend: Backend = "auto"
