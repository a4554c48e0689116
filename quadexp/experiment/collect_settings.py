"""Settings of a data set: how it is flown, and what is a target in it. Nothing heavy is imported here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from quadexp.errors import UsageError
from quadexp.parts.part import Part
from quadexp.parts.settings import Setting


@dataclass(frozen=True, kw_only=True)
class CollectConfig(Part):
    """How a data set is flown: flights of `flight_duration` until `duration` is reached, speeds spread evenly over
    [speed_min, speed_max]. mode: random (smooth random paths) or setpoints (jumps between random points).
    target, identified: of recorded flights; see quadexp/models/recorded.py."""

    prefix: ClassVar[str] = "collect."

    mode: Annotated[Literal["random", "setpoints"], Setting("smooth random paths, or jumps between random points")] = (
        "random"
    )
    duration: Annotated[float, Setting("total flight time", "(0, 86400]", "s")] = 300.0
    flight_duration: Annotated[float, Setting("length of one flight", "[2, 3600]", "s")] = 20.0
    speed_min: Annotated[
        float, Setting("peak speed of the slowest path; the others are spread evenly", "(0, 60]", "m/s")
    ] = 5.0
    speed_max: Annotated[float, Setting("peak speed of the fastest path", "(0, 60]", "m/s")] = 20.0
    extent: Annotated[float, Setting("edge of the cube that the paths stay in", "(0, 1000]", "m")] = 6.0
    clearance: Annotated[float, Setting("height of the lowest point, world", "[-1000, 1000]", "m")] = 1.0
    frame: Annotated[
        Literal["midpoint", "start"],
        Setting(
            "instant of the features of a transition: its middle (second order), or its start as in the paper (first"
            " order)"
        ),
    ] = "midpoint"
    thrust: Annotated[
        Literal["delivered", "commanded"],
        Setting(
            "thrust between two samples of a simulated flight: what the rotors delivered, by their logged speeds or by"
            " a motor lag and a delay fitted to the flights, or what was commanded"
        ),
    ] = "delivered"
    state: Annotated[
        Literal["estimate", "truth"],
        Setting("of a simulated flight with an estimator: the estimate that the controller was told, or the truth"),
    ] = "estimate"
    target: Annotated[
        Literal["auto", "specific_force", "velocity"],
        Setting(
            "target of recorded flights: specific force of the accelerometer (auto), or derivative of the velocity"
        ),
    ] = "auto"
    identified: Annotated[
        str | None, Setting("folder written by `quadexp identify`, whose thrust curve recorded flights need")
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.speed_min > self.speed_max:
            raise UsageError(f"collect.speed_min={self.speed_min}: must not exceed collect.speed_max={self.speed_max}")
