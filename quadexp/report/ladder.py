"""What each imperfection of the world costs each controller: a ladder of worlds, as a table and as a figure.

The rows are those of one plant in several worlds (`plant` is "simplified/only_motor_lag"). The first world, which has
no imperfection, is the foot of the ladder: every other one stands beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.files.writer import write_text
from quadexp.report.figures import save
from quadexp.report.statistics import Statistic, compute_statistics
from quadexp.report.style import Figure, entries, looks, plain_log, styled
from quadexp.report.table import Table
from quadexp.report.tables import course_labels, plant_labels
from quadexp.report.text import speed_text

ACROSS = 2  # panels of the figure side by side

Row = Mapping[str, Any]
Place = tuple[str, float]  # trajectory with what else varies, speed


def draw(rows: Sequence[Row], out: Path) -> dict[str, str]:
    """Table and figure into <out>; returns name -> path."""
    return {
        "table_ladder": str(write_text(out / "ladder.md", ladder_table(rows).markdown())),
        "figure_ladder": str(save(ladder_figure(rows), out / "figures" / "ladder", inside=out)),
    }


def world_of(plant: str) -> str:
    """The world's name in the name of a plant."""
    return plant.partition("/")[2] or "clean"


def by_world(rows: Sequence[Row]) -> dict[str, dict[Place, dict[str, Statistic]]]:
    """World, in the order of the rows -> place -> label of a contestant -> statistic of the mean error."""
    found: dict[str, dict[Place, dict[str, Statistic]]] = {world_of(row["plant"]): {} for row in rows}
    statistics = compute_statistics(rows, metrics=("mean_error",))
    courses = course_labels((s.trajectory, s.setting) for s in statistics)
    for s, label in zip(statistics, plant_labels(statistics), strict=True):
        found[world_of(s.plant)].setdefault((courses[s.trajectory, s.setting], s.speed), {})[label] = s
    return {world: dict(sorted(places.items())) for world, places in found.items()}


def _labels(worlds: Mapping[str, Mapping[Place, Mapping[str, Statistic]]]) -> list[str]:
    return list(dict.fromkeys(name for places in worlds.values() for found in places.values() for name in found))


def ladder_table(rows: Sequence[Row]) -> Table:
    """Mean position error (mm) by world and controller, of every trajectory and speed."""
    worlds = by_world(rows)
    names = _labels(worlds)
    lines = [
        [world, trajectory, speed_text(speed, ""), *(cell(found.get(name)) for name in names)]
        for world, places in worlds.items()
        for (trajectory, speed), found in places.items()
    ]
    title = "Mean distance of the true position from the reference over the flight (mm), mean over seeds"
    return Table(["world", "trajectory", "m/s", *names], lines, title, left=frozenset({0, 1}))


def cell(s: Statistic | None) -> str:
    """The mean, or how many of its flights did not end well."""
    if s is None:
        return ""
    if s.failures:
        return ", ".join(f"{count} of {s.seeds} {outcome}" for outcome, count in s.failures.items())
    return f"{1e3 * s.mean:.3g}"


@styled
def ladder_figure(rows: Sequence[Row]) -> Figure:
    """Mean position error (mm, logarithmic) in every world, a panel per trajectory and speed, a marker per controller.

    A bar spans its interval over seeds. There is no marker where a flight did not end well.
    """
    worlds = by_world(rows)
    places = sorted({place for found in worlds.values() for place in found})
    names = _labels(worlds)
    look = looks(names)
    lines = -(-len(places) // ACROSS)
    size = (1.6 + 3.4 * min(ACROSS, len(places)), 0.8 + lines * (0.7 + 0.24 * len(worlds)))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(lines, min(ACROSS, len(places)), sharex=True, sharey=True, squeeze=False)
    for panel, place in zip(panels.flat, places, strict=False):
        for name in names:
            points = [
                (1e3 * s.mean, 1e3 * s.low, 1e3 * s.high, i)
                for i, found in enumerate(worlds.values())
                if (s := found.get(place, {}).get(name)) and not s.failures
            ]
            if points:
                mean, low, high, heights = zip(*points, strict=True)
                panel.hlines(heights, low, high, color=look[name].colour, linewidth=2, alpha=0.4)
                panel.plot(mean, heights, label=name, **look[name].points() | {"linestyle": "none"})
        panel.set(xscale="log", title=f"{place[0]} {speed_text(place[1])}".strip())
    for panel in panels.flat[len(places) :]:
        panel.set_axis_off()
    panels[0, 0].set_yticks(range(len(worlds)), [name.replace("_", " ") for name in worlds])
    panels[0, 0].invert_yaxis()
    plain_log(panels[0, 0].xaxis, minor=True)
    for panel in panels[-1]:
        panel.set_xlabel("mean position error (mm)")
    figure.legend(*entries(panels.flat), loc="outside lower center", ncols=len(names))
    return figure
