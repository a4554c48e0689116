"""Mean errors place by place, all controllers beside each other: as a table and as a figure.

A place is a plant (or a world), a trajectory and a speed. Each controller's mean is over all its flights there, and
there is none where a flight was not completed. So the ladder of worlds says what each imperfection costs: its rows are
those of one plant in several worlds (`plant` is "simplified/only_motor_lag"), first the one without any.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
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
    contestants = grouped((s.plant, s.contestant) for s in statistics)
    # By plant: the same controller has checkpoints of its own on another one.
    labels_on = {plant: contestant_labels(flown) for plant, flown in contestants.items()}
    places: dict[tuple[str, str, float], dict[str, Statistic]] = {}
    labels = []
    for s in statistics:
        where = s.plant if first == "plant" else s.plant.partition("/")[2] or "clean"
        label = labels_on[s.plant][s.contestant]
        place = where, courses[s.trajectory, s.setting], s.speed
        places.setdefault(place, {})[label] = s
        labels.append(label)
    lines = distinct(place[:2] for place in places)
    in_order = sorted(places, key=lambda place: (lines.index(place[:2]), place[2]))
    stated = [name for name in order if name in labels]
    return Means(first, distinct([*stated, *labels]), {place: places[place] for place in in_order})


def means_table(means: Means, title: str, *, bold: bool = False) -> Table:
    """A line a place, a column a controller. bold: mark the best of a line (winner.py)."""
    lines = []
    for (where, course, speed), by_label in means.places.items():
        cells = []
        for label in means.labels:
            statistic = by_label.get(label)
            cells.append(_cell(statistic, bold) if statistic else "")
        lines.append([where, course, speed_text(speed, ""), *cells])
    return Table([means.first, "trajectory", "m/s", *means.labels], lines, title, left=frozenset({0, 1}))


def _cell(s: Statistic, bold: bool) -> str:
    """The mean, or how many of its flights were not completed."""
    if s.failures:
        return ", ".join(f"{count} of {s.seeds} {outcome}" for outcome, count in s.failures.items())
    text = f"{1e3 * s.mean:.0f}" if s.mean >= 0.1 else f"{1e3 * s.mean:.3g}"
    return f"**{text}**" if bold and s.best else text


def means_figure(means: Means) -> Figure:
    """Over the worlds, a panel for each course and speed; or over the speed, a panel for each plant and course."""
    places: dict[Place, Point] = {}
    for label in means.labels:
        for (where, course, speed), by_label in means.places.items():
            s = by_label.get(label)
            if s is None:
                continue
            point = Point(s.mean, s.low, s.high, s.n, s.n, *s.flown, method=s.interval)
            if s.failures:
                point = replace(point, mean=math.nan, low=math.nan, high=math.nan)
            at = (course, speed, label, where) if means.first == "world" else (where, course, label, speed)
            places[at] = point
    if means.first == "world":
        facet = ("trajectory", "trajectory.speed")
        x = Axis("world", tuple(distinct(where for where, _, _ in means.places)), "group")
    else:
        facet = ("plant", "trajectory")
        x = Axis.of("trajectory.speed", sorted({speed for _, _, speed in means.places}))
    return figure_of(View("lines", "mean_error", x, ("controller",), facet, places=places))
