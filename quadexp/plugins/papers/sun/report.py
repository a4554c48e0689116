"""Tables and a figure of a sweep over the conditions of Sun et al. 2022, ours beside the published ones.

As there, a flight counts with its RMSE, a crashed one with 5 m and 90 degrees. Because this mixes two things, the error
of the flights that did not crash and the number of those that did stand apart, and so do flights that stayed inside the
box but are more than 2 m off: they are not flown.

Errors "as logged" are our reading of the published metric, an RMSE of position, which does not say of which position.
With poses 10 ms old the printed error is that without delay, which the true position cannot give to a controller
without prediction: at 12 m/s it is 0.12 m further. So the position is taken to be the one that the controller was
given, of age d, recorded after a call of the software at 300 Hz: that is two steps of a simulation at 500 Hz, T, after
the instant of the reference and the command that are recorded with it:

    e(t) = p(t + T - d) - p_r(t),     T = 2/500 s
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.log.cell_store import CellStore
from quadexp.log.outcome import COMPLETED
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.names import named
from quadexp.parts.settings import declared
from quadexp.physics.state import POSITION
from quadexp.plugins.drawing.style import Figure
from quadexp.plugins.page.draw import figure_of
from quadexp.plugins.page.places import Place, Point
from quadexp.plugins.page.view import Axis, View
from quadexp.plugins.papers.ellipse import Ellipse as ReferenceEllipse
from quadexp.plugins.papers.sun.data import CRASHED, FLIGHTS, INFEASIBLE, Ellipse, Published, ellipses, published
from quadexp.report.inference import holm, mean_interval, paired_permutation
from quadexp.report.pairing import Row, Rows, grouped
from quadexp.report.paper import Drawn
from quadexp.report.table import Table

MASS = 0.75  # kg, of the vehicle
THRUST = 4 * 8.5  # N, likewise
DEFAULTS = {"acceleration": 20.0, "ratio": 1.0}  # of an ellipse, where a sweep does not vary it
OFF = 2.0  # m of RMSE; a flight that is further off is not flown, although it stays inside the box
RECORDED_AFTER = 2 / 500  # s: the first instant of their simulation not before the end of a period of 1/300 s
ALPHA = 0.05  # of intervals and tests
CLOSE = 0.2  # share by which a mean may differ and count as reproduced
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
OURS = "sun_mpc"  # the controller others are compared with
KNOWN_AGE = "+strapdown"  # late rows have it, others need not
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
        position = np.array([row["rmse"] for row in rows], float)
        heading = np.degrees(np.array([row["heading_rmse"] for row in rows], float))
        logged = np.array([row.get("rmse_logged", math.nan) for row in rows], float)
        numbers: Any = [len(rows), int(lost.sum()), int((position[~lost] > OFF).sum())]
        # The errors of all flights, a lost one as it counts there; and of those that did not crash
        for counts, values in zip((*CRASHED, CRASHED[0]), (position, heading, logged), strict=True):
            counted = np.where(lost, counts, values)
            numbers += [(float(counted.mean()), float(counted.std())), _mean(values[~lost])]
        could = np.array([_possible(row) for row in rows], bool)
        numbers += [int(could.sum()), int((lost & could).sum()), _mean(position[~lost & could])]
        return cls(*numbers)

    @property
    def texts(self) -> list[str]:
        """Position, the same as logged, heading, and how many are lost or off."""
        lost = f"{self.lost} + {self.off}" if self.off else str(self.lost)
        return [_with_sd(self.position, 3), _with_sd(self.logged, 3), _with_sd(self.heading, 1), lost]


def _mean(values: np.ndarray) -> float:
    """NaN without values."""
    if len(values):
        return float(values.mean())
    return math.nan


def _possible(row: Row) -> bool:
    """Whether the rotors give the thrust that the row's ellipse takes, in its world."""
    mass, thrust = WEAKER.get(_world(row), (1.0, 1.0))
    return mass == thrust or _ellipse(row).thrust(mass * MASS) <= thrust * THRUST


def _ellipse(row: Row) -> Ellipse:
    stated = dict(part.split("=", 1) for part in row.get("variant", "").split() if "=" in part)
    number = {name: float(stated.get(f"trajectory.{name}", default)) for name, default in DEFAULTS.items()}
    plane = stated.get("trajectory.plane", "horizontal")
    numbers = (float(row["speed"]), number["acceleration"], number["ratio"])
    return Ellipse(plane, *numbers, feasible=Ellipse(plane, *numbers, feasible=False) not in ellipses())


def _world(row: Row) -> str:
    world = str(row["plant"].partition("/")[2]).partition(SENSOR)[0]
    if world != "sun_baseline" or _ellipse(row).feasible:
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
    worlds = {name: grouped((_world(row), row) for row in groups[name]) for name in names}
    return {name: {world: Condition.of(of[world]) for world in _in_order(of)} for name, of in worlds.items()}


def _in_order(worlds: Iterable[str]) -> list[str]:
    worlds = list(worlds)
    return [*(world for world in TITLES if world in worlds), *(world for world in worlds if world not in TITLES)]


def reproduced(mean: float, survivors: float, printed: Published) -> str:
    """ "yes" for a mean position error (m) within CLOSE of the printed one; "crashes" where that of the flights that
    did not crash is within it, so that the number of crashes explains the difference; else "no"; "" for NaN."""
    if np.isnan(mean):
        return ""
    if abs(mean / printed.position - 1) <= CLOSE:
        return "yes"
    if abs(survivors / printed.survivors - 1) <= CLOSE:
        return "crashes"
    return "no"


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


def draw(rows: Rows, out: Path) -> Drawn:
    """Tables and figure of a sweep."""
    flown = conditions(with_logged(rows, out))
    texts = [sun_table(flown), *(table.markdown() for table in [compared(rows)] if table.rows)]
    return {"sun": "\n\n".join(texts)}, {"sun": sun_figure(flown)}


def compared(flights: Iterable[Row]) -> Table:
    """Every controller against OURS with the same remedies, paired by ellipse; no line without one.

    Mean over ellipses of the RMSE with its 95 % interval, a lost flight counted as there. The ellipses are what varies:
    none of these plants has noise.
    """
    errors: dict[tuple[str, str], dict[Ellipse, float]] = {}
    rows = [(str(row["controller"]), _world(row), row) for row in flights]
    plain = {(name, world) for name, world, _ in rows}
    for name, world, row in rows:
        short = name.removesuffix(KNOWN_AGE)
        key = (name if (short, world) in plain else short, world)
        lost = row["outcome"] not in COMPLETED
        errors.setdefault(key, {})[_ellipse(row)] = CRASHED[0] if lost else float(row["rmse"])
    pairs = {}
    for (name, world), mean_error in errors.items():
        who, plus, remedies = name.partition("+")
        ours = errors.get((OURS + plus + remedies, world), {})
        if who != OURS and (both := [ellipse for ellipse in mean_error if ellipse in ours]):
            pairs[name, world] = paired_permutation(np.array([mean_error[pair] - ours[pair] for pair in both]))
    differs = named(pairs, holm(np.array([*pairs.values()])) < ALPHA)
    our_names = {OURS + "".join(name.partition("+")[1:]) for name, _ in pairs}
    names = [
        name for name in dict.fromkeys(name for name, _ in errors) if name in our_names | {who for who, _ in pairs}
    ]

    def text(name: str, world: str) -> str:
        values = np.array([*errors.get((name, world), {}).values()])
        low, high, method = mean_interval(values, 1 - ALPHA, least=0.0)
        limits = "" if method == "none" else f" [{low:.3f}, {high:.3f}]"
        return f"{_mean(values):.3f}{limits}{'*' * bool(differs.get((name, world)))}" if len(values) else ""

    worlds = _in_order(dict.fromkeys(world for _, world in pairs))
    title = f"RMSE (m), mean over ellipses [95 % interval], a lost flight {CRASHED[0]:g} m; * differs from {OURS} with"
    title += f" the same remedies (p < {ALPHA:g}, permutations paired by ellipse, Holm over {len(pairs)})"
    lines = [[TITLES.get(world, world), *(text(name, world) for name in names)] for world in worlds]
    return Table(["condition", *names], lines, title)


def sun_table(flown: Mapping[str, Mapping[str, Condition]]) -> str:
    """Markdown: every published controller, ours and theirs; every other one beside the best printed; all together."""
    tables = [_beside(name, flown[name]) for name in PUBLISHED if name in flown]
    tables += [_against_best(name, worlds) for name, worlds in flown.items() if name not in PUBLISHED]
    return "\n\n".join([*tables, _all(flown).markdown()])


def overview(rows: Iterable[Row]) -> Table:
    """All controllers side by side."""
    return _all(conditions(rows))


def _beside(name: str, worlds: Mapping[str, Condition]) -> str:
    printed = published()
    lines = []
    verdicts: dict[str, list[str]] = {"true position": [], "as logged": []}
    for world, ours in worlds.items():
        line = [TITLES.get(world, world), *ours.texts, _number(ours.survivors, 3)]
        beside = [""] * 6
        if (theirs := printed.get((world, name))) is not None:
            verdicts["true position"].append(reproduced(ours.position[0], ours.survivors, theirs))
            verdicts["as logged"].append(reproduced(ours.logged[0], ours.logged_survivors, theirs))
            beside = [
                _with_sd((theirs.position, theirs.position_sd), 3),
                _with_sd((theirs.heading, theirs.heading_sd), 1),
            ]
            beside += [str(theirs.lost), _number(theirs.survivors, 3), *(texts[-1] for texts in verdicts.values())]
        lines.append(line + beside)
    heads = (
        "condition",
        "position (m)",
        "as logged (m)",
        "heading (deg)",
        "lost + > 2 m",
        "survivors (m)",
        "printed position (m)",
        "printed heading (deg)",
        "printed lost",
        "printed survivors (m)",
        "reproduced",
        "as logged",
    )
    notes = []
    for title, texts in verdicts.items():
        if texts:
            counts = ", ".join(f"{word} {texts.count(word)}" for word in ("yes", "crashes", "no"))
            notes.append(f"Mean position within {CLOSE:.0%} of the printed one, {title}: {counts} of {len(texts)}")
    flights = ", ".join(str(number) for number in sorted({condition.flights for condition in worlds.values()}))
    title = f"{name}: mean (SD) over {flights} flights of the RMSE; a lost flight counts {CRASHED[0]:g} m"
    return Table(heads, lines, title, notes=[*notes, *_apart(name, worlds)]).markdown()


def _against_best(name: str, worlds: Mapping[str, Condition]) -> str:
    """Both readings of the error beside the best mean that is printed, whichever controller has it."""
    best: dict[str, float] = {}
    for (world, _), theirs in published().items():
        best[world] = min(theirs.position, best.get(world, math.inf))
    lines = []
    for world, ours in worlds.items():
        possible = f"{_number(ours.possible_position, 3)} ({ours.possible})" if ours.possible < ours.flights else ""
        below = []
        for error in (ours.position, ours.logged):
            below.append("yes" if error[0] < best.get(world, -math.inf) else "no")
        printed = _number(best.get(world, math.nan), 3)
        lines.append([TITLES.get(world, world), *ours.texts, possible, printed, *below])
    heads = (
        "condition",
        "position (m)",
        "as logged (m)",
        "heading (deg)",
        "lost + > 2 m",
        "possible (m, flights)",
        "best printed (m)",
        "below",
        "as logged",
    )
    return Table(heads, lines, f"{name}: mean (SD) over the flights, beside the best mean printed").markdown()


def _apart(name: str, worlds: Mapping[str, Condition]) -> list[str]:
    """Lines on the ellipses that the rotors can fly, where they cannot fly all, and on the infeasible set."""
    lines = [
        f"{TITLES.get(world, world)}: {condition.possible} ellipses take no more thrust than there is;"
        f" {condition.possible_lost} of these lost, the others {condition.possible_position:.3f} m"
        for world, condition in worlds.items()
        if condition.possible < condition.flights
    ]
    if INFEASIBLE_SET in worlds and name in INFEASIBLE:
        ours = worlds[INFEASIBLE_SET]
        (position, heading) = INFEASIBLE[name]
        lines.append(
            f"Infeasible ellipses, flights that did not crash: {ours.survivors:.3f} m, {ours.survivors_heading:.1f}"
            f" degrees; printed {position:.2f} m, {heading:.1f} degrees"
        )
    return lines


def _all(flown: Mapping[str, Mapping[str, Condition]]) -> Table:
    """All controllers: mean of the flights that did not crash, and how many did or are more than OFF m away."""
    worlds = _in_order({world: None for by_world in flown.values() for world in by_world})
    lines = []
    for world in worlds:
        lines.append([TITLES.get(world, world), *(_short(by_world.get(world)) for by_world in flown.values())])
    title = "RMSE of the flights that did not crash (m); in brackets how many crashed + how many others are off by 2 m"
    return Table(["condition", *flown], lines, title)


def _short(condition: Condition | None) -> str:
    if condition is None:
        return ""
    text = _number(condition.survivors, 3)
    if condition.lost or condition.off:
        return f"{text} ({condition.lost}+{condition.off})"
    return text


def _with_sd(values: tuple[float, float], digits: int) -> str:
    return f"{values[0]:.{digits}f} ({values[1]:.{digits}f})"


def _number(value: float, digits: int) -> str:
    if np.isfinite(value):
        return f"{value:.{digits}f}"
    return "-"


def sun_figure(flown: Mapping[str, Mapping[str, Condition]]) -> Figure:
    """Position error of the flights that did not crash by condition, "k/n" where some did, beside what is printed."""
    places: dict[Place, Point] = {}
    for name, worlds in flown.items():
        for world, ours in worlds.items():
            places[name, world] = Point(ours.survivors, ended=ours.flights - ours.lost, trials=ours.flights)
        for (world, controller), theirs in published().items():
            if controller == name and world in worlds:
                point = Point(theirs.survivors, ended=FLIGHTS - theirs.lost, trials=FLIGHTS)
                places[f"{name} printed", world] = point
    names = TITLES | {"survivors": "survivors' position error (m)", "world": "condition"}
    x = Axis("world", tuple(_in_order(dict.fromkeys(world for _, world in places))), "group", names)
    return figure_of(View("lines", "survivors", x, ("controller",), places=places, names=names))
