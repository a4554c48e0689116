"""Settings of winds that change: a gust, turbulence, a record. The constant wind stands in world.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from quadexp.config.settings import Setting, Settings, Triple
from quadexp.config.world import ConstantWindKeys, WorldPartConfig
from quadexp.errors import UsageError


@dataclass(frozen=True)
class GustKeys(ConstantWindKeys):
    """A mean wind and one gust of one-minus-cosine shape."""

    amplitude: Annotated[Triple, Setting("velocity that the gust adds at its peak, world", "[-50, 50]", "m/s")] = (
        5.0,
        0.0,
        0.0,
    )
    onset: Annotated[float, Setting("when the gust begins", "[0, 14400]", "s")] = 2.0
    duration: Annotated[
        float, Setting("how long it lasts: its length over the airspeed it is met at", "[0.01, 14400]", "s")
    ] = 2.0


@dataclass(frozen=True, kw_only=True)
class GustConfig(GustKeys, WorldPartConfig):
    """A discrete gust; see quadexp/world/gust.py."""

    effect = "quadexp.world.gust:Gust"


@dataclass(frozen=True)
class DrydenKeys(ConstantWindKeys):
    """A mean wind and turbulence after Dryden."""

    intensity: Annotated[
        Triple | None,
        Setting(
            "standard deviations along the mean wind, across and vertical; null: by altitude and wind_at_6m",
            "[0, 50]",
            "m/s",
        ),
    ] = None
    wind_at_6m: Annotated[
        float | None,
        Setting(
            "wind speed 6 m over the ground that sets the intensity; null: that of the mean wind", "[0, 50]", "m/s"
        ),
    ] = None
    altitude: Annotated[
        float,
        Setting("height over the ground that sets scale lengths, and intensities by wind_at_6m", "[3.048, 304.8]", "m"),
    ] = 6.096
    length: Annotated[
        Triple | None,
        Setting("scale lengths along, across and vertical; null: by altitude", "[0.01, 10000]", "m"),
    ] = None
    airspeed: Annotated[
        float | None,
        Setting(
            "speed at which the turbulence passes; null: the vehicle's own through the mean wind, by control period",
            "[0.01, 100]",
            "m/s",
        ),
    ] = None
    airspeed_min: Annotated[
        float,
        Setting("least of the vehicle's own airspeed that counts: air does not stand frozen", "[0.01, 100]", "m/s"),
    ] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.intensity is not None and self.wind_at_6m is not None:
            raise UsageError(
                f"wind.wind_at_6m={self.wind_at_6m:g}: wind.intensity is given too; one of the two sets the intensity"
            )


@dataclass(frozen=True, kw_only=True)
class DrydenConfig(DrydenKeys, WorldPartConfig):
    """Continuous turbulence, MIL-F-8785C in its low-altitude form; see quadexp/world/dryden.py."""

    effect = "quadexp.world.dryden:Dryden"


@dataclass(frozen=True, kw_only=True)
class WindFileKeys(Settings):
    """A wind that was recorded."""

    prefix: ClassVar[str] = "wind."

    path: Annotated[
        str, Setting("CSV or Parquet file with the columns t (s), wind_x, wind_y, wind_z (m/s, world); a flight is one")
    ]


@dataclass(frozen=True, kw_only=True)
class WindFileConfig(WindFileKeys, WorldPartConfig):
    """Wind from a file; see quadexp/world/wind_record.py."""

    effect = "quadexp.world.wind_record:WindFromFile"
