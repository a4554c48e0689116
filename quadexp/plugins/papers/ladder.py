"""Mean errors place by place, all controllers beside each other: as a table and as a figure.

A place is a plant (or a world), a trajectory and a speed. Each controller's mean is over all its flights there, and
there is none where a flight was not completed. So the ladder of worlds says what each imperfection costs: its rows are
those of one plant in several worlds (`plant` is "simplified/only_motor_lag"), first the one without any.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from quadexp.names import distinct
from quadexp.plugins.drawing.style import Figure
from quadexp.plugins.page.draw import figure_of
from quadexp.plugins.page.places import Place, Point
from quadexp.plugins.page.view import Axis, View
from quadexp.report.pairing import Rows, contestant_labels, grouped
from quadexp.report.paper import Drawn
from quadexp.report.statistics import Statistic, compute_statistics
from quadexp.report.table import Table
from quadexp.report.tables import course_labels
from quadexp.report.text import speed_text

First = Literal["plant", "world"]
TITLE = "Mean distance of the true position from the reference over the flight (mm), mean over seeds"


class Means(NamedTuple):
    """first: what a place begins with. labels: of the controllers, in order. places: (plant or world, course, speed)
    -> label -> mean error."""

    first: First
    labels: list[str]
    places: dict[tuple[str, str, float], dict[str, Statistic]]


def draw(rows: Rows, out: Path) -> Drawn:
    """Table and figure of the ladder."""
    return {"ladder": overview(rows).markdown()}, {"ladder": means_figure(means_by_place(rows, "world"))}


def overview(rows: Rows) -> Table:
    """Mean position error (mm) by world and controller, of every trajectory and speed."""
    return means_table(means_by_place(rows, "world"), TITLE)


def means_by_place(rows: Rows, first: First, order: Sequence[str] = ()) -> Means:
    """Statistics of the mean error: courses in the order of the rows, speeds ascending. order: of labels that come
    before the others."""
    statistics = compute_statistics(rows, metrics=("mean_error",))
    courses = course_labels((s.trajectory, s.setting) for s in statistics)
    # By plant: the same controller has checkpoints of its own on another one.
    flown = grouped((s.plant, s.contestant) for s in statistics)
    told_apart = {plant: contestant_labels(contestants) for plant, contestants in flown.items()}
    labels = [told_apart[s.plant][s.contestant] for s in statistics]
    speeds: dict[tuple[str, str], dict[float, dict[str, Statistic]]] = {}
    for s, label in zip(statistics, labels, strict=True):
        world = s.plant.partition("/")[2] or "clean"
        at = s.plant if first == "plant" else world, courses[s.trajectory, s.setting]
        speeds.setdefault(at, {}).setdefault(s.speed, {})[label] = s
    places = {(*at, speed): of_speed[speed] for at, of_speed in speeds.items() for speed in sorted(of_speed)}
    return Means(first, distinct([*(name for name in order if name in labels), *labels]), places)


def means_table(means: Means, title: str, *, bold: bool = False) -> Table:
    """A line a place, a column a controller. bold: mark the best of a line (winner.py)."""

    def cell(s: Statistic | None) -> str:
        """The mean, or how many of its flights were not completed."""
        if s is None:
            return ""
        if s.failures:
            return ", ".join(f"{count} of {s.seeds} {outcome}" for outcome, count in s.failures.items())
        text = f"{1e3 * s.mean:.0f}" if s.mean >= 0.1 else f"{1e3 * s.mean:.3g}"
        return f"**{text}**" if bold and s.best else text

    lines = []
    for (place, course, speed), by_label in means.places.items():
        lines.append([place, course, speed_text(speed, ""), *(cell(by_label.get(label)) for label in means.labels)])
    return Table([means.first, "trajectory", "m/s", *means.labels], lines, title, left=frozenset({0, 1}))


def means_figure(means: Means) -> Figure:
    """Over the worlds, a panel for each course and speed; or over the speed, a panel for each plant and course."""
    places: dict[Place, Point] = {}
    for label in means.labels:
        for (place, course, speed), by_label in means.places.items():
            if (s := by_label.get(label)) is not None:
                at = (course, speed, label, place) if means.first == "world" else (place, course, label, speed)
                mean, low, high = (math.nan,) * 3 if s.failures else (s.mean, s.low, s.high)
                places[at] = Point(mean, low, high, s.n, s.n, *s.flown, method=s.interval)
    worlds = dict.fromkeys(at[0] for at in means.places)
    speeds = sorted({at[2] for at in means.places})
    x = Axis("world", tuple(worlds), "group")
    facet = ("trajectory", "trajectory.speed")
    if means.first == "plant":
        x = Axis.of("trajectory.speed", speeds)
        facet = ("plant", "trajectory")
    return figure_of(View("lines", "mean_error", x, ("controller",), facet, places=places))
