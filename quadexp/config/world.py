"""Settings of the world around an airframe: what every part has, and the first parts.

A part of the world is one option of its group (`wind=constant`, `link=latency`); each group has one that does nothing.
`effect` names the class in quadexp/world that the settings configure, as module:class; "" where they do nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from quadexp.config.flight import Name
from quadexp.config.settings import Setting, Settings, Triple


@dataclass(frozen=True, kw_only=True)
class WorldPartConfig(Settings):
    """A part of the world; by itself, the option that does nothing."""

    effect: ClassVar[str] = ""

    name: Name

    @property
    def idle(self) -> bool:
        """Whether it does nothing: the world is made without it."""
        return not self.effect


# ------------------------------------------------------------------------------------------------------------ wind
@dataclass(frozen=True)
class ConstantWindKeys(Settings):
    """Air that moves at one velocity."""

    prefix: ClassVar[str] = "wind."

    velocity: Annotated[Triple, Setting("velocity of the air, world", "[-50, 50]", "m/s")] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class ConstantWindConfig(ConstantWindKeys, WorldPartConfig):
    """The same wind everywhere and at all times; see quadexp/world/constant_wind.py."""

    effect = "quadexp.world.constant_wind:ConstantWind"


# ------------------------------------------------------------------------------------------------------------ link
@dataclass(frozen=True)
class LatencyKeys(Settings):
    """Commands that arrive late, or not at all."""

    prefix: ClassVar[str] = "link."

    latency: Annotated[float, Setting("least time between a command and its thrust", "[0, 0.5]", "s")] = 0.0
    jitter: Annotated[
        float, Setting("what a command may take longer, uniform from command to command", "[0, 0.5]", "s")
    ] = 0.0
    drop: Annotated[float, Setting("probability that a command is lost; the last one holds", "[0, 1)")] = 0.0


@dataclass(frozen=True, kw_only=True)
class LatencyConfig(LatencyKeys, WorldPartConfig):
    """Latency, jitter and loss of commands; see quadexp/world/link.py."""

    effect = "quadexp.world.link:Latency"


# ------------------------------------------------------------------------------------------------------- estimator
@dataclass(frozen=True)
class StatedEstimateKeys(Settings):
    """The truth with stated noise and delay."""

    prefix: ClassVar[str] = "estimator."

    position_noise: Annotated[float, Setting("standard deviation of the position, per axis", "[0, 10]", "m")] = 0.0
    velocity_noise: Annotated[float, Setting("standard deviation of the velocity, per axis", "[0, 10]", "m/s")] = 0.0
    attitude_noise: Annotated[float, Setting("standard deviation of the attitude, per axis", "[0, 1]", "rad")] = 0.0
    rate_noise: Annotated[float, Setting("standard deviation of the body rate, per axis", "[0, 10]", "rad/s")] = 0.0
    delay: Annotated[float, Setting("age of the state that is told", "[0, 0.5]", "s")] = 0.0
    gyro: Annotated[
        Literal["late", "fresh"],
        Setting("body rate that is told: as old as the rest of the state, or that of now, as a gyroscope's is"),
    ] = "late"


@dataclass(frozen=True, kw_only=True)
class StatedEstimateConfig(StatedEstimateKeys, WorldPartConfig):
    """No estimator: the truth, with noise and delay where they are set; see quadexp/world/stated_estimate.py."""

    effect = "quadexp.world.stated_estimate:StatedEstimate"

    @property
    def idle(self) -> bool:
        """See WorldPartConfig."""
        noise = (self.position_noise, self.velocity_noise, self.attitude_noise, self.rate_noise)
        return not any((*noise, self.delay))
