"""The data of Sun et al. 2022: 144 ellipses with their Table III, and Tables IV and V.

ellipses.csv: plane, speed V (m/s), acceleration a (m/s^2), ratio n, feasible (1 or 0). published.csv: world,
controller, mean and standard deviation over flights of the RMSE of position (m) and of heading (deg), and crashes (%).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd

from quadexp.physics.vehicle import GRAVITY

FLIGHTS = 75  # behind the published tables: every crash rate is a multiple of 1/75
CRASHED = (5.0, 90.0)  # m and deg, for which a crashed flight counts
# Ideal case of the infeasible ellipses, printed in the text: m and deg, crashed flights left out.
INFEASIBLE = {"sun_nmpc+indi": (0.40, 12.7), "sun_dfbc+indi": (0.77, 33.4)}


@dataclass(frozen=True)
class Ellipse:
    """One of the 144. speed: m/s. acceleration: m/s^2."""

    plane: str
    speed: float
    acceleration: float
    ratio: float
    feasible: bool

    def thrust(self, mass: float) -> float:
        """Largest collective thrust that it takes of a mass (kg) without drag (N)."""
        angle = np.linspace(0, 2 * np.pi, 721)
        along = self.acceleration * np.sin(angle)
        across = self.acceleration / self.ratio * np.cos(angle)
        if self.plane == "horizontal":
            return float(mass * np.sqrt(along**2 + across**2 + GRAVITY**2).max())
        return float(mass * np.sqrt(along**2 + (across - GRAVITY) ** 2).max())


@dataclass(frozen=True)
class Published:
    """A mean over the flights of one condition. position: m. heading: deg. *_sd: standard deviations. crash: %."""

    position: float
    position_sd: float
    heading: float
    heading_sd: float
    crash: float

    @property
    def lost(self) -> int:
        """Crashed flights."""
        return round(self.crash / 100 * FLIGHTS)

    @property
    def survivors(self) -> float:
        """Mean position error of the flights that did not crash (m)."""
        return (FLIGHTS * self.position - CRASHED[0] * self.lost) / (FLIGHTS - self.lost)


@cache
def ellipses() -> tuple[Ellipse, ...]:
    """All 144, the horizontal ones first."""
    table = _table("ellipses.csv").astype({"speed": float, "acceleration": float, "ratio": float, "feasible": bool})
    return tuple(Ellipse(**row) for row in table.to_dict("records"))


@cache
def published() -> dict[tuple[str, str], Published]:
    """(world, controller) -> what is printed."""
    table = _table("published.csv").set_index(["world", "controller"]).astype(float)
    return {place: Published(*row) for place, row in zip(table.index, table.to_numpy().tolist(), strict=True)}


def _table(name: str) -> pd.DataFrame:
    return pd.read_csv(Path(__file__).with_name(name))
