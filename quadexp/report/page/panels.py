"""The page's figures: what was swept, and error against computing time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from matplotlib.ticker import FuncFormatter

from quadexp.errors import UsageError
from quadexp.report.document import Block, Section
from quadexp.report.draw import figure_of
from quadexp.report.frame import SweepFrame
from quadexp.report.page.source import TABLED, Comparison
from quadexp.report.style import Figure, figure_html, plain_log, styled
from quadexp.report.tables import TITLES
from quadexp.report.text import duration, shown, typeset
from quadexp.report.view import SUCCESS, View, automatic

BUDGET = 650_000  # characters of all figures over what was swept
TIME = (
    "For a controller on the line, no other one has both a shorter step and a smaller error; bounds are never on it."
    " Wall time of the control step: medians over the flights of their median and 99th percentile. Other load on the"
    " machine increases the latter."
)
SWEPT = (
    "The axes are the keys that take several values. Means are over the flights that all compared settings completed;"
    " k/n: only k of n flights were completed; a cross: none was, or the settings contradict each other. `quadexp plot`"
    " draws other axes."
)
ACCENT, ALARM = "#0b63a5", "#b3261e"  # of the page


@dataclass
class Swept:
    """The figures that `quadexp plot` draws without keys. tabs: name, title and figures (HTML) of each quantity. left:
    what is not on the page. views: of the main quantity."""

    tabs: list[tuple[str, str, list[str]]] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    views: list[View] = field(default_factory=list)

    @classmethod
    def of(cls, comparison: Comparison) -> Swept:
        """The figures that are chosen by what was swept, as many as there is room for."""
        swept, frame, room = cls(), SweepFrame.read(comparison.root), BUDGET
        for metric in dict.fromkeys((comparison.metric, *TABLED, SUCCESS)):
            try:
                views = automatic(frame, metric, comparison.confidence)
            except UsageError:  # no flight has it
                continue
            swept.views = swept.views or views
            figures: list[str] = []
            for view in views:
                name = view.file_name.replace("_", " ")
                drawn = figure_html(figure_of(view), f"{view.y_label}, {name}. {view.caption}")
                if (room := room - len(drawn)) > 0:
                    figures.append(drawn)
                else:
                    swept.left.append(f"{view.y_label} {name}, which `quadexp plot` draws")
            swept.tabs += [(metric, views[0].y_label, figures)] if figures else []
        return swept

    def figures(self) -> dict[str, Figure]:
        """Name -> figure of the main quantity."""
        return {f"{view.y.removesuffix('_error')}_error_{view.file_name}": figure_of(view) for view in self.views}


def swept_section(swept: Swept) -> Section:
    """A tab a quantity."""
    blocks = [Block(title, name, figures=figures) for name, title, figures in swept.tabs]
    return Section("swept", "Swept", "What was swept", SWEPT, blocks)


class Point(NamedTuple):
    """time, tail: of the step, median and 99th percentile (s). error, low, high: in percent of the baseline's over all
    conditions; without a baseline the geometric mean in the printed unit (without an interval)."""

    time: float
    tail: float
    error: float
    low: float = math.nan
    high: float = math.nan


def pareto_points(comparison: Comparison) -> dict[str, Point]:
    """By label, of all who have a completed flight."""
    points: dict[str, Point] = {}
    for label in comparison.order:
        time, pooled = comparison.time(label), comparison.overall.get(label)
        if not math.isfinite(time):
            continue
        times = time, max(time, comparison.time(label, "p99"))
        if comparison.reference is None:
            points[label] = Point(*times, shown(comparison.metric)[0] * comparison.geometric_mean(label))
        elif label == comparison.reference:
            points[label] = Point(*times, 100.0)
        elif pooled is not None and math.isfinite(pooled.reduction):
            limits = 100 - pooled.reduction_high, 100 - pooled.reduction_low
            points[label] = Point(*times, 100 - pooled.reduction, *limits)
    return points


def pareto_front(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Labels for which no other is better in both time and error, by time."""
    front = [
        label
        for label, (time, error) in points.items()
        if not any(t <= time and e <= error and (t, e) != (time, error) for t, e in points.values())
    ]
    return sorted(front, key=lambda label: points[label][0])


@styled
def pareto_figures(comparison: Comparison) -> dict[str, Figure]:
    """Error against the time of one control step, both axes logarithmic; the front joined, bounds aside, and the
    deadline marked. Empty where nobody has a completed flight.

    A point: median time; the whisker to the right: 99th percentile; the vertical bar: interval of the error.
    """
    if not (points := pareto_points(comparison)):
        return {}
    front = pareto_front({label: (p.time, p.error) for label, p in points.items() if label not in comparison.bounds})
    figure = Figure(figsize=(6.2, 4.3), layout="constrained")
    panel = figure.subplots()
    panel.step([1e6 * points[x].time for x in front], [points[x].error for x in front], where="post", color=ACCENT)
    for label, point in points.items():
        look, time = comparison.look[label], 1e6 * point.time
        panel.vlines(time, max(point.low, 1e-6), point.high, color=look.colour, linewidth=3.2, alpha=0.35)
        panel.hlines(point.error, time, 1e6 * point.tail, color=look.colour, linewidth=1.0, alpha=0.55)
        marker = {**look.points(), "markersize": 8, "linestyle": "none"}
        panel.plot(time, point.error, **marker, zorder=4, label=label)
    periods = [period for label in points if math.isfinite(period := comparison.period(label))]
    times = [1e6 * t for t in (*(t for point in points.values() for t in point[:2]), *periods)]
    errors = [value for point in points.values() for value in point[2:] if math.isfinite(value) and value > 0]
    panel.set(xscale="log", yscale="log", xlim=(min(times) / 1.5, max(times) * 1.9))
    panel.set_ylim(min(errors) / 2.2, max(errors) * 2.2)
    if periods:
        panel.axvspan(1e6 * min(periods), panel.get_xlim()[1], color=ALARM, alpha=0.08, linewidth=0)
        panel.axvline(1e6 * min(periods), color=ALARM, linewidth=1.0)
        due = f"next command due, {typeset(duration(min(periods), exact=True))}"
        place: dict[str, Any] = {"transform": panel.get_xaxis_transform(), "ha": "right", "va": "bottom"}
        panel.text(0.97e6 * min(periods), 0.03, due, rotation=90, color=ALARM, fontsize=7.5, **place)
    for axis in (panel.xaxis, panel.yaxis):
        plain_log(axis)
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: typeset(duration(1e-6 * value, exact=True))))
    panel.set_xlabel("time of one control step: median, whisker to the 99th percentile")
    against = comparison.reference and f"error (% of {comparison.reference})"
    panel.set_ylabel(against or f"{TITLES[comparison.metric]} ({shown(comparison.metric)[1]}), geometric mean")
    figure.legend(loc="outside lower center", ncols=min(4, len(points)))
    return {"error_against_time": figure}


def pareto_section(figures: Mapping[str, Figure]) -> Section:
    """The figure."""
    drawn = [figure_html(figure, "Error against computing time") for figure in figures.values()]
    return Section("time", "Time", "Error against computing time", TIME, [Block(figures=drawn)] if drawn else [])
