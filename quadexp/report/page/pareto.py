"""Error against the time of one control step: who is on the front, which no other controller beats in both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

from matplotlib.ticker import FuncFormatter

from quadexp.report.page.sheet import ACCENT, ALARM, WIDE, Sheet
from quadexp.report.page.source import Comparison
from quadexp.report.style import plain_log
from quadexp.report.tables import TITLES
from quadexp.report.text import duration, percent, shown, typeset


class Point(NamedTuple):
    """time: of the step (s), median. error, low, high: in percent of the baseline's over all conditions; without a
    baseline the geometric mean in the printed unit (without an interval)."""

    time: float
    error: float
    low: float = math.nan
    high: float = math.nan


def pareto_sheets(comparison: Comparison) -> list[Sheet]:
    """The one sheet, with a line for every contestant in it; none without a completed flight."""
    points = pareto_points(comparison)
    if not points:
        return []
    front = pareto_front(points, comparison.bounds)
    draws = {"Error against computing time": partial(pareto_panel, comparison=comparison, points=points, front=front)}
    lines = {label: _line(comparison, label, points[label], front) for label in points}
    return [Sheet("error_against_time", "", draws, list(points), size=WIDE, lines=lines)]


def _line(comparison: Comparison, label: str, point: Point, front: Sequence[str]) -> str:
    """Where a contestant stands, its error against the baseline's, and the load of its step."""
    where = "a bound" if label in comparison.bounds else "on the front" if label in front else "behind the front"
    size = f"{percent(point.error)[0]} of {comparison.reference}'s error, in " if comparison.reference else ""
    size = "the baseline, in " if label == comparison.reference else size
    share = 100 * point.time / comparison.period(label)
    load = f", {percent(share)[0] if share >= 0.05 else 'under 0.1 %'} of its period" if math.isfinite(share) else ""
    return f"{where}: {size}{duration(point.time)}{load}."


def pareto_points(comparison: Comparison) -> dict[str, Point]:
    """Label -> its point, of all with a completed flight."""
    points: dict[str, Point] = {}
    for label in comparison.order:
        time, pooled = comparison.time(label), comparison.overall.get(label)
        if not math.isfinite(time):
            continue
        if comparison.reference is None:
            points[label] = Point(time, shown(comparison.metric)[0] * comparison.geometric_mean(label))
        elif label == comparison.reference:
            points[label] = Point(time, 100.0)
        elif pooled is not None and math.isfinite(pooled.reduction):
            low, high = 100 - pooled.reduction_high, 100 - pooled.reduction_low
            points[label] = Point(time, 100 - pooled.reduction, low, high)
    return points


def pareto_front(points: dict[str, Any], bounds: Sequence[str] = ()) -> list[str]:
    """Labels for which no other is better in both time and error, by time. bounds: labels to leave out."""
    rivals = {label: point[:2] for label, point in points.items() if label not in bounds}
    front = [
        label
        for label, (time, error) in rivals.items()
        if not any(t <= time and e <= error and (t, e) != (time, error) for t, e in rivals.values())
    ]
    return sorted(front, key=lambda label: rivals[label][0])


def pareto_panel(panel: Any, comparison: Comparison, points: dict[str, Point], front: Sequence[str]) -> None:
    """Error against the time of one control step, both logarithmic; the front joined, the deadline marked.

    A point: median time; the whisker to the right: 99th percentile; the vertical bar: interval of the error.
    """
    panel.step([1e6 * points[x].time for x in front], [points[x].error for x in front], where="post", color=ACCENT)
    tails = {label: max(comparison.time(label, "p99"), point.time) for label, point in points.items()}
    for label, (time, error, low, high) in points.items():
        look = comparison.look[label]
        panel.vlines(1e6 * time, max(low, 1e-6), high, color=look.colour, linewidth=3.2, alpha=0.35)
        panel.hlines(error, 1e6 * time, 1e6 * tails[label], color=look.colour, linewidth=1.0, alpha=0.55)
        panel.plot(1e6 * time, error, **{**look.points(), "markersize": 8, "linestyle": "none"}, zorder=4)
    periods = [period for label in points if math.isfinite(period := comparison.period(label))]
    times = [1e6 * t for t in (*(point.time for point in points.values()), *tails.values(), *periods)]
    errors = [value for point in points.values() for value in point[1:] if math.isfinite(value) and value > 0]
    panel.set(xscale="log", yscale="log", xlim=(min(times) / 1.5, max(times) * 1.9))
    panel.set_ylim(min(errors) / 2.2, max(errors) * 2.2)
    if periods:
        panel.axvspan(1e6 * min(periods), panel.get_xlim()[1], color=ALARM, alpha=0.08, linewidth=0)
        panel.axvline(1e6 * min(periods), color=ALARM, linewidth=1.0)
        due = f"next command due, {typeset(duration(min(periods), exact=True))}"
        place = {"transform": panel.get_xaxis_transform(), "ha": "right", "va": "bottom"}
        panel.text(0.97e6 * min(periods), 0.03, due, rotation=90, color=ALARM, fontsize=7.5, **place)
    plain_log(panel.yaxis)
    plain_log(panel.xaxis)
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: typeset(duration(1e-6 * value, exact=True))))
    panel.set_xlabel("time of one control step: median, whisker to the 99th percentile")
    against = comparison.reference and f"error (% of {comparison.reference})"
    panel.set_ylabel(against or f"{TITLES[comparison.metric]} ({shown(comparison.metric)[1]}), geometric mean")
