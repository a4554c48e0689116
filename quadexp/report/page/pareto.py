"""Error against the time of one control step: who is on the front, which no other controller beats in both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.ticker import FuncFormatter

from quadexp.report.page.palette import Palette, dress
from quadexp.report.page.sheet import WIDE, Sheet
from quadexp.report.page.source import Comparison, spoken
from quadexp.report.style import plain_log
from quadexp.report.tables import TITLES
from quadexp.report.text import duration, percent, shown, typeset

Points = dict[str, tuple[float, float, float, float]]  # label -> time of the step (s), error, its low, its high


def pareto_sheets(comparison: Comparison) -> list[Sheet]:
    """The one sheet, with a line for every contestant in it; none without a flight that ended well."""
    points = pareto_points(comparison)
    if not points:
        return []
    front = pareto_front(points, comparison.bounds)
    draws = {"Error against computing time": partial(pareto_panel, comparison=comparison)}
    lines = [{"label": label, "text": _line(comparison, label, points[label], front)} for label in points]
    return [Sheet("error_against_time", "", draws, size=WIDE, more={"lines": lines})]


def _line(comparison: Comparison, label: str, point: tuple[float, ...], front: Sequence[str]) -> str:
    """Where a contestant stands, its error against the baseline's, and the load of its step."""
    time, error, *_ = point
    against = f"{percent(error)[0]} of {spoken(comparison.reference)}'s error" if comparison.reference else ""
    size = "the baseline" if label == comparison.reference else against
    share = 100 * time / comparison.period(label)
    load = f", {percent(share)[0] if share >= 0.05 else 'under 0.1 %'} of its period" if math.isfinite(share) else ""
    where = "a bound" if label in comparison.bounds else "on the front" if label in front else "behind the front"
    return f"{where}: {size + ', in ' if size else ''}{duration(time)}{load}."


def pareto_points(comparison: Comparison) -> Points:
    """Label -> (time of the step, s; error, its low, its high) of all with a flight that ended well.

    The error is in percent of the baseline's over all conditions; without a baseline the geometric mean in the printed
    unit (without an interval).
    """
    points: Points = {}
    factor, _ = shown(comparison.metric)
    for label in comparison.order:
        time, one = comparison.time(label), comparison.overall.get(label)
        if not math.isfinite(time):
            continue
        if comparison.reference is None:
            points[label] = (time, factor * comparison.geometric_mean(label), math.nan, math.nan)
        elif label == comparison.reference:
            points[label] = (time, 100.0, math.nan, math.nan)
        elif one is not None and math.isfinite(one.reduction):
            points[label] = (time, 100 - one.reduction, 100 - one.reduction_high, 100 - one.reduction_low)
    return points


def pareto_front(points: Points, bounds: Sequence[str] = ()) -> list[str]:
    """Labels for which no other is better in both time and error, by time. bounds: labels to leave out."""
    rivals = {label: point for label, point in points.items() if label not in bounds}
    front = [
        label
        for label, (time, error, *_) in rivals.items()
        if not any(t <= time and e <= error and (t, e) != (time, error) for t, e, *_ in rivals.values())
    ]
    return sorted(front, key=lambda label: points[label][0])


def pareto_panel(panel: Any, comparison: Comparison, palette: Palette) -> None:
    """Error against the time of one control step, both logarithmic; the front joined, the deadline marked.

    A point: median time; the whisker to the right: 99th percentile; the vertical bar: interval of the error.
    """
    points = pareto_points(comparison)
    front = pareto_front(points, comparison.bounds)
    tails = {label: comparison.time(label, "p99") for label in points}
    corners = [points[label][:2] for label in front]
    stairs = [(t, e) for (t0, e0), (t1, _) in zip(corners, corners[1:], strict=False) for t, e in ((t0, e0), (t1, e0))]
    path = np.array([*stairs, *corners[-1:]])
    if len(front) > 1:
        panel.plot(1e6 * path[:, 0], path[:, 1], color=palette.accent, linewidth=1.1, alpha=0.6, zorder=1)
    for label, (time, error, low, high) in points.items():
        look, colour = comparison.look[label], palette.series[comparison.look[label].token]
        faded = 1.0 if label in front else 0.75
        if math.isfinite(low):
            panel.vlines(1e6 * time, max(low, 1e-6), high, color=colour, linewidth=3.2, alpha=0.35)
        panel.hlines(error, 1e6 * time, 1e6 * max(tails[label], time), color=colour, linewidth=1.0, alpha=0.55)
        panel.plot(1e6 * time, error, markersize=8, alpha=faded, zorder=4, linestyle="none", **palette.mark(look))
    periods = [p for label in points if math.isfinite(p := comparison.period(label))]
    times = [1e6 * t for t in (*(p[0] for p in points.values()), *tails.values(), *periods)]
    errors = [v for p in points.values() for v in p[1:] if math.isfinite(v) and v > 0]
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlim(min(times) / 1.5, max(times) * 1.9)
    panel.set_ylim(min(errors) / 2.2, max(errors) * 2.2)
    if periods:
        deadline = 1e6 * min(periods)
        panel.axvspan(deadline, panel.get_xlim()[1], color=palette.alarm, alpha=0.08, linewidth=0)
        panel.axvline(deadline, color=palette.alarm, linewidth=1.0)
        panel.annotate(
            f"next command due, {typeset(duration(min(periods), exact=True))}", (deadline, 0.03), (-4, 0),
            xycoords=("data", "axes fraction"), textcoords="offset points", rotation=90, ha="right", va="bottom",
            color=palette.alarm, fontsize=7.5,
        )  # fmt: skip
    _name_points(panel, comparison, points, front, palette)
    plain_log(panel.yaxis)
    plain_log(panel.xaxis)
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: typeset(duration(1e-6 * value, exact=True))))
    panel.set_xlabel("time of one control step: median, whisker to the 99th percentile")
    unit = shown(comparison.metric)[1]
    against = comparison.reference and f"error (% of {spoken(comparison.reference)})"
    panel.set_ylabel(against or f"{TITLES[comparison.metric]} ({unit}), geometric mean")
    dress(panel, palette)


def _name_points(panel: Any, comparison: Comparison, points: Points, front: Sequence[str], palette: Palette) -> None:
    """Write the names beside the points, without covering other names or points."""
    height = 72 * panel.figure.get_size_inches()[1]
    at = {
        label: panel.transData.transform((1e6 * time, error)) * 72 / panel.figure.dpi
        for label, (time, error, *_) in points.items()
    }
    taken = [(x - 5, y - 5, x + 5, y + 5) for x, y in at.values()]
    for label in sorted(points, key=lambda label: -points[label][1]):
        name = spoken(label)
        x, y = at[label]
        spots = [(-2, 8), (-2, -17), (-2, 20), (-2, -29), (-2, 32)]
        boxes = [(x + dx, y + dy, x + dx + 5.1 * len(name), y + dy + 9) for dx, dy in spots]
        free = [not any(_overlap(box, other) for other in taken) and 0 < box[1] < height for box in boxes]
        chosen = free.index(True) if any(free) else 0
        taken.append(boxes[chosen])
        panel.annotate(
            name, points[label][:2] * np.array([1e6, 1.0]), spots[chosen], textcoords="offset points", ha="left",
            va="bottom", color=palette.series[comparison.look[label].token], fontsize=8.5,
            fontweight="bold" if label in front else "normal",
        )  # fmt: skip


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    """Whether two boxes (left, bottom, right, top) meet."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
