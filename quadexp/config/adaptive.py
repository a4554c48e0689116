"""Settings of the remedies of the group adaptive: what is added to a controller's commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from quadexp.config.remedies import RemedyConfig
from quadexp.config.settings import Setting, Settings


@dataclass(frozen=True, kw_only=True)
class L1Keys(Settings):
    """Predictor, low pass and limits of L1 adaptive augmentation; see quadexp/control/l1.py."""

    prefix: ClassVar[str] = "adaptive."

    velocity_pole: Annotated[
        float, Setting("a_v: rate at which the error of the predicted velocity decays", "(0, 1000]", "1/s")
    ] = 1.0
    rate_pole: Annotated[
        float, Setting("a_w: rate at which the error of the predicted body rate decays", "(0, 1000]", "1/s")
    ] = 1.0
    bandwidth: Annotated[
        float,
        Setting(
            "w_co: cutoff of the low pass between estimate and command. With motors that lag by tau a third to a fifth"
            " of 1/tau; far above it the loop is unstable",
            "(0, 1000]",
            "rad/s",
        ),
    ] = 10.0
    force_limit: Annotated[float, Setting("largest thrust that is added or taken away", "[0, 10]", "of the weight")] = (
        1.0
    )
    torque_limit: Annotated[
        float, Setting("largest angular acceleration that is added about each body axis", "[0, 1e4]", "rad/s^2")
    ] = 50.0
    motor_lag: Annotated[
        float | None,
        Setting("time constant of the rotors in the predictor; null: what the controller knows", "[0, 0.5]", "s"),
    ] = None
    dead_time: Annotated[
        float | None,
        Setting("delay of the commands in the predictor; null: what the controller knows", "[0, 0.5]", "s"),
    ] = None
    unmatched: Annotated[
        bool,
        Setting("tell the controller the lateral force, which rotors cannot cancel, through the same low pass"),
    ] = False


@dataclass(frozen=True, kw_only=True)
class L1Config(L1Keys, RemedyConfig):
    """L1 adaptive augmentation (Hanover et al. 2022, Wu et al. 2023)."""

    remedy: ClassVar[str] = "quadexp.control.l1:l1"
