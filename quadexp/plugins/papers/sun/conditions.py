"""Flights over the conditions of Sun et al. 2022, counted as there: a flight with its RMSE, a crashed one with 5 m and
90 degrees.

Because this mixes two things, the error of the flights that did not crash and the number of those that did stand apart,
and so do flights that stayed inside the box but are more than 2 m off: they are not flown.

Errors "as logged" are our reading of the published metric, an RMSE of position, which does not say of which position.
With poses 10 ms old the printed error is that without delay, which the true position cannot give to a controller
without prediction: at 12 m/s it is 0.12 m further. So the position is taken to be the one that the controller was
given, of age d, recorded after a call of the software at 300 Hz: that is two steps of a simulation at 500 Hz, T, after
the instant of the reference and the command that are recorded with it:

    e(t) = p(t + T - d) - p_r(t),     T = 2/500 s
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.log.cell_store import CellStore
from quadexp.log.outcome import COMPLETED
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.parts.settings import declared
from quadexp.physics.state import POSITION
from quadexp.plugins.papers.ellipse import Ellipse as ReferenceEllipse
from quadexp.plugins.papers.sun.data import CRASHED, Ellipse, ellipses
from quadexp.report.pairing import Row, grouped

MASS = 0.75  # kg, of the vehicle
THRUST = 4 * 8.5  # N, likewise
DEFAULTS = {"acceleration": 20.0, "ratio": 1.0}  # of an ellipse, where a sweep does not vary it
OFF = 2.0  # m of RMSE; a flight that is further off is not flown, although it stays inside the box
RECORDED_AFTER = 2 / 500  # s: the first instant of their simulation not before the end of a period of 1/300 s
TITLES = {
    "sun_baseline": "baseline",
    "sun_drag_50": "+50 % drag",
    "sun_drag_100": "+100 % drag",
    "sun_mass_minus_30": "-30 % mass",
    "sun_mass_30": "+30 % mass",
    "sun_com_10": "10 % CoG",
    "sun_com_15": "15 % CoG",
    "sun_ct_minus_30": "-30 % c_t",
    "sun_ct_30": "+30 % c_t",
    "sun_cq_minus_30": "-30 % c_q",
    "sun_cq_30": "+30 % c_q",
    "sun_force_5": "5 N",
    "sun_force_10": "10 N",
    "sun_force_15": "15 N",
    "sun_torque_01": "0.1 N m",
    "sun_torque_02": "0.2 N m",
    "sun_torque_03": "0.3 N m",
    "sun_late_10": "10 ms",
    "sun_late_30": "30 ms",
    "sun_late_50": "50 ms",
}
WEAKER = {"sun_mass_30": (1.3, 1.0), "sun_ct_minus_30": (1.0, 0.7)}  # world -> factors on mass and on thrust
INFEASIBLE_SET = "sun_baseline, infeasible"  # as a world: the ideal case of the infeasible ellipses
SENSOR = ",sensor="  # behind a world's name: sensors that are not exact
PUBLISHED = ("sun_nmpc", "sun_dfbc", "sun_nmpc+indi", "sun_dfbc+indi")


@dataclass(frozen=True)
class Condition:
    """The flights of one controller in one world, as Sun et al. count them.

    flights, lost, off: numbers of flights, of crashed ones, of others with more than OFF m. position, heading: mean and
    standard deviation (m, deg). survivors, survivors_heading: means of the flights that did not crash (m, deg).
    logged, logged_survivors: position and survivors with the error as logged (m), NaN where it is not known.
    possible: flights whose ellipse the rotors can fly in this world; how many of them crashed, and the mean position
    error of the others (m).
    """

    flights: int
    lost: int
    off: int
    position: tuple[float, float]
    survivors: float
    heading: tuple[float, float]
    survivors_heading: float
    logged: tuple[float, float]
    logged_survivors: float
    possible: int
    possible_lost: int
    possible_position: float

    @classmethod
    def of(cls, rows: Iterable[Row]) -> Condition:
        """From the rows of its flights."""
        rows = list(rows)
        lost = np.array([row["outcome"] not in COMPLETED for row in rows])  # by their box, not by a corridor
        possible = np.array([_possible(row) for row in rows])
        position = np.array([row["rmse"] for row in rows], float)
        heading = np.degrees(np.array([row["heading_rmse"] for row in rows], float))
        logged = np.array([row.get("rmse_logged", math.nan) for row in rows], float)

        def counted(values: np.ndarray, crashed: float) -> tuple[float, float]:
            """Mean and standard deviation over all flights, a lost one as it counts there."""
            every = np.where(lost, crashed, values)
            return float(every.mean()), float(every.std())

        return cls(
            flights=len(rows),
            lost=int(lost.sum()),
            off=int((position[~lost] > OFF).sum()),
            position=counted(position, CRASHED[0]),
            survivors=mean_of(position[~lost]),
            heading=counted(heading, CRASHED[1]),
            survivors_heading=mean_of(heading[~lost]),
            logged=counted(logged, CRASHED[0]),
            logged_survivors=mean_of(logged[~lost]),
            possible=int(possible.sum()),
            possible_lost=int((lost & possible).sum()),
            possible_position=mean_of(position[~lost & possible]),
        )


def mean_of(values: np.ndarray) -> float:
    """NaN without values."""
    if len(values):
        return float(values.mean())
    return math.nan


def _possible(row: Row) -> bool:
    """Whether the rotors give the thrust that the row's ellipse takes, in its world."""
    mass, thrust = WEAKER.get(world_of(row), (1.0, 1.0))
    return mass == thrust or ellipse_of(row).thrust(mass * MASS) <= thrust * THRUST


def ellipse_of(row: Row) -> Ellipse:
    stated = dict(part.split("=", 1) for part in row.get("variant", "").split() if "=" in part)
    number = {name: float(stated.get(f"trajectory.{name}", default)) for name, default in DEFAULTS.items()}
    plane = stated.get("trajectory.plane", "horizontal")
    numbers = (float(row["speed"]), number["acceleration"], number["ratio"])
    return Ellipse(plane, *numbers, feasible=Ellipse(plane, *numbers, feasible=False) not in ellipses())


def world_of(row: Row) -> str:
    world = str(row["plant"].partition("/")[2]).partition(SENSOR)[0]
    if world != "sun_baseline" or ellipse_of(row).feasible:
        return world
    return INFEASIBLE_SET


def _flown_by(row: Row) -> str:
    """The controller with its remedies, and its sensors where they are not exact."""
    sensor = str(row["plant"]).partition(SENSOR)[2]
    if sensor:
        return f"{row['controller']}, {sensor} sensors"
    return str(row["controller"])


def conditions(rows: Iterable[Row]) -> dict[str, dict[str, Condition]]:
    """Controller (with its variant's remedies and sensors) -> world -> condition; both in the order of the tables."""
    groups = grouped((_flown_by(row), row) for row in rows)
    names = [*(name for name in PUBLISHED if name in groups), *(name for name in groups if name not in PUBLISHED)]
    by_name = {}
    for name in names:
        worlds = grouped((world_of(row), row) for row in groups[name])
        by_name[name] = {world: Condition.of(worlds[world]) for world in in_order(worlds)}
    return by_name


def in_order(worlds: Iterable[str]) -> list[str]:
    worlds = list(worlds)
    return [*(world for world in TITLES if world in worlds), *(world for world in worlds if world not in TITLES)]


def logged_rmse(flight: Flight) -> float:
    """RMSE (m) as logged, of an ellipse's flight and the samples that it has; NaN without samples."""
    if not len(flight):
        return math.nan
    config = flight.metadata["config"]
    stated = {}
    for name, value in config["trajectory"].items():
        if name in declared(ReferenceEllipse):
            stated[name] = value
    late = config.get("estimator", {}).get("delay", 0.0)
    t = np.maximum(flight.t + late - RECORDED_AFTER, 0.0)  # of the reference with which this position is recorded
    error = flight.state[:, POSITION] - ReferenceEllipse(**stated).flat_output(t).position[:, 0]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def with_logged(rows: Iterable[Row], out: str | Path) -> list[dict[str, Any]]:
    """Rows of a sweep with `rmse_logged` (m), from the flights of its folder; NaN where a flight is not there."""
    paths = [(row, CellStore(out).path(row["key"])) for row in rows]
    return [
        {**row, "rmse_logged": logged_rmse(read_flight(path, check=False)) if path.is_file() else math.nan}
        for row, path in paths
    ]
