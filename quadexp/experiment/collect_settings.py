"""Settings of a data set: how it is flown, and what is a target in it. Nothing heavy is imported here."""

from __future__ import annotations

from typing import Literal

from quadexp.errors import UsageError
from quadexp.parts.part import Part
from quadexp.parts.settings import key, keyed


@keyed
class CollectConfig(Part):
    """How a data set is flown: flights of at most `flight_duration` until `duration` is reached, speeds spread evenly
    over [speed_min, speed_max]. mode: random (smooth random paths) or setpoints (jumps between random points).
    target, identified: of recorded flights."""

    prefix = "collect."

    mode: Literal["random", "setpoints"] = key("random", "smooth random paths, or jumps between random points")
    duration: float = key(300.0, "total flight time", "(0, 86400]", "s")
    flight_duration: float | None = key(
        None, "longest flight; null: a lap of a random path, 20 s of setpoints", "[2, 3600]", "s"
    )
    speed_min: float = key(5.0, "peak speed of the slowest path; the others are spread evenly", "(0, 60]", "m/s")
    speed_max: float = key(20.0, "peak speed of the fastest path", "(0, 60]", "m/s")
    extent: float = key(6.0, "edge of the cube that the paths stay in", "(0, 1000]", "m")
    clearance: float = key(1.0, "height of the lowest point, world", "[-1000, 1000]", "m")
    frame: Literal["midpoint", "start"] = key(
        "midpoint",
        "instant of a transition's features: its middle (second order), or its start as published (first order)",
    )
    thrust: Literal["delivered", "commanded"] = key(
        "delivered",
        "delivered: by logged rotor speeds or a fitted lag and delay; commanded: as commanded",
        when="identified=null",
    )
    state: Literal["estimate", "truth"] = key(
        "estimate", "of a simulated flight with an estimator: the estimate that the controller was given, or the truth"
    )
    target: Literal["auto", "specific_force", "velocity"] = key(
        "auto", "target of recorded flights: specific force of the accelerometer (auto), or derivative of the velocity"
    )
    identified: str | None = key(None, "checkpoint folder whose thrust curve recorded flights need")

    def check_together(self) -> None:
        if self.speed_min > self.speed_max:
            raise UsageError(f"collect.speed_min={self.speed_min}: must not exceed collect.speed_max={self.speed_max}")
