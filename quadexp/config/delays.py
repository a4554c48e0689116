"""Settings of the remedies against measurements that come late (group `delay`); see docs/delays.md."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from quadexp.config.remedies import RemedyConfig
from quadexp.config.settings import Setting, Settings


@dataclass(frozen=True, kw_only=True)
class DelayKeys(Settings):
    """How old the state is that the controller is told."""

    prefix: ClassVar[str] = "delay."

    time: Annotated[float, Setting("age of the measured state that is made good", "[0, 0.5]", "s")] = 0.01


@dataclass(frozen=True, kw_only=True)
class StrapdownConfig(DelayKeys, RemedyConfig):
    """A late state is brought to now by gyroscope and accelerometer; see quadexp/control/delay/strapdown.py."""

    remedy = "quadexp.control.delay.strapdown:around"


@dataclass(frozen=True, kw_only=True)
class PredictionConfig(DelayKeys, RemedyConfig):
    """A late state is brought to now by the controller's model; see quadexp/control/delay/prediction.py."""

    remedy = "quadexp.control.delay.prediction:around"

    dead_time: Annotated[
        float | None,
        Setting(
            "dead time of commands; null: what the controller predicts itself; one that is no MPC is told the state and"
            " the reference after it",
            "[0, 0.5]",
            "s",
        ),
    ] = None
    motor_lag: Annotated[
        float | None, Setting("time constant of the rotors; null: what the controller knows itself", "[0, 0.5]", "s")
    ] = None


@dataclass(frozen=True, kw_only=True)
class IdentifiedDelayConfig(RemedyConfig):
    """Delays that are found in flight; see quadexp/control/delay/identified.py."""

    prefix = "delay."
    remedy = "quadexp.control.delay.identified:around"

    after: Annotated[
        float,
        Setting(
            "time of the flight in which delays are looked for at first; then again until all are known, and once more"
            " each time that the flight is half as long again, until they are known well",
            "[2, 60]",
            "s",
        ),
    ] = 3.0
    assumed: Annotated[float, Setting("dead time that is predicted until they are known", "[0, 0.1]", "s")] = 0.03
