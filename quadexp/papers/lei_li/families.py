"""The two families of controllers on both plants, as a table and as a figure.

Learned residuals (GP, linear drag) and identified physics (RLS on the blade-element model), with feedback and with MPC.
`perfect_mpc` and `oracle_feedback` know the plant and are the bounds of their kinds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from quadexp.report.statistics import Statistic, compute_statistics
from quadexp.report.style import Figure, entries, looks, plain_log, styled
from quadexp.report.table import Table
from quadexp.report.tables import course_labels, plant_labels
from quadexp.report.text import speed_text

ORDER = (
    "nominal_mpc", "linear_drag_mpc", "gp_mpc", "rls_mpc", "perfect_mpc", "static_feedback", "rls_feedback",
    "oracle_feedback",
)  # fmt: skip

Row = Mapping[str, Any]
Course = tuple[str, str]  # plant, trajectory


def by_course(rows: Sequence[Row]) -> dict[Course, dict[float, dict[str, Statistic]]]:
    """(plant, trajectory with what else varies) -> speed, ascending -> label of a contestant -> statistic of the mean
    error."""
    found: dict[Course, dict[float, dict[str, Statistic]]] = {}
    statistics = compute_statistics(rows, metrics=("mean_error",))
    courses = course_labels((s.trajectory, s.setting) for s in statistics)
    for s, label in zip(statistics, plant_labels(statistics), strict=True):
        found.setdefault((s.plant, courses[s.trajectory, s.setting]), {}).setdefault(s.speed, {})[label] = s
    return {course: dict(sorted(speeds.items())) for course, speeds in found.items()}


def _labels(courses: Mapping[Course, Mapping[float, Mapping[str, Statistic]]]) -> list[str]:
    """Those of ORDER first."""
    there = {name for speeds in courses.values() for found in speeds.values() for name in found}
    return [*(name for name in ORDER if name in there), *sorted(there - set(ORDER))]


def families_table(rows: Sequence[Row]) -> str:
    """Markdown: mean position error (mm) by condition and controller; bold by the rule of report/winner.py."""
    courses = by_course(rows)
    names = _labels(courses)
    lines = [
        [plant, trajectory, speed_text(speed, ""), *(_cell(found.get(name)) for name in names)]
        for (plant, trajectory), speeds in courses.items()
        for speed, found in speeds.items()
    ]
    title = (
        "Mean position error over the flight (mm), over seeds; bold: least error of a line over the flights that all"
        " ended well, significantly less than every other (corrected for the choice among them and for the lines), by a"
        " controller with no fewer flights; bounds are not ranked"
    )
    return Table(["plant", "trajectory", "m/s", *names], lines, title, left=frozenset({0, 1})).markdown()


def _cell(s: Statistic | None) -> str:
    """The mean over all flights, or how many of them did not end well."""
    if s is None:
        return ""
    if s.failures:
        return ", ".join(f"{count} of {s.seeds} {outcome}" for outcome, count in s.failures.items())
    text = f"{1e3 * s.mean:.0f}" if s.mean >= 0.1 else f"{1e3 * s.mean:.3g}"
    return f"**{text}**" if s.best else text


@styled
def families_figure(rows: Sequence[Row]) -> Figure:
    """Mean position error (mm, logarithmic) over speed; a row of panels per plant, a panel per trajectory.

    A condition has no point if one of its flights did not end well.
    """
    courses = by_course(rows)
    plants, trajectories = (list(dict.fromkeys(course[i] for course in courses)) for i in (0, 1))
    size = (1.0 + 2.7 * len(trajectories), 0.9 + 2.6 * len(plants))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(plants), len(trajectories), sharey=True, squeeze=False)
    names = _labels(courses)
    look = looks(names)
    for line, plant in zip(panels, plants, strict=True):
        for panel, trajectory in zip(line, trajectories, strict=True):
            speeds = courses.get((plant, trajectory), {})
            for name in names:
                points = [(v, 1e3 * s.mean) for v, found in speeds.items() if (s := found.get(name)) and not s.failures]
                if points:
                    panel.plot(*zip(*points, strict=True), label=name, linewidth=1.2, **look[name].points())
            panel.set(yscale="log", title=f"{trajectory}, {plant}", xticks=list(speeds))
            panel.margins(x=0.1)
        line[0].set_ylabel("mean position error (mm)")
    plain_log(panels[0, 0].yaxis, minor=True)
    for panel in panels[-1]:
        panel.set_xlabel("trajectory.speed (m/s)")
    found = dict(zip(*reversed(entries(panels.flat)), strict=True))
    names = [name for name in names if name in found]
    figure.legend([found[name] for name in names], names, loc="outside lower center", ncols=4)
    return figure
