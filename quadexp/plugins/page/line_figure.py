"""Lines: a panel for every value of `facet`, a line for every value of `by`, bars for the interval.

Values of a key that is no number stand side by side. Where flights were lost stands "k/n"; where none completed, a
cross at the upper edge.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadexp.plugins.drawing.style import PLAIN, Figure, Look, entries, looks, plain_log
from quadexp.plugins.page.panel_grid import is_log, panel_grid
from quadexp.plugins.page.places import SUCCESS, Place, Point
from quadexp.plugins.page.view import Axis, View, value_text
from quadexp.report.frame import unit_of

APART = 0.065  # share of a panel between two labels of ticks
SPREAD = 0.6  # of the room of a group, taken by its places side by side
LEAST_SEEN = 1e-9  # of a logarithmic axis, for an interval that reaches down to zero
MOST_TICKS = 8  # of a panel
HIGHEST = 0.97  # of a panel, where the crosses of the first line stand; those of the others below it
BETWEEN = 0.055  # between the crosses of two lines, of a panel
LEVELS = 5  # of crosses


@dataclass(frozen=True)
class Line:
    """A line of every panel. place: its values of `by`. name: in the legend. k: its number among n."""

    place: Place
    name: str
    look: Look
    k: int
    n: int

    @property
    def shift(self) -> float:
        """Where it stands in a group, from the middle."""
        return SPREAD * ((self.k + 0.5) / self.n - 0.5)

    @property
    def cross(self) -> dict[str, Any]:
        """Keywords of `plot` for a place without a completed flight."""
        return {"marker": "x", "markersize": 5, "color": self.look.colour, "linestyle": "none"}


def line_figure(view: View) -> Figure:
    look = looks_of(view)
    lines = []
    for k, place in enumerate(look):
        lines.append(Line(place, label_of(view, place, view.names), look[place], k, len(look)))
    grouped = view.x.kind == "group"
    width = max(3.1, 0.42 * len(view.x.values)) if grouped else 3.1
    names = [line.name for line in lines]
    most = max(1, int(12.4 / width))
    figure, grid, columns = panel_grid(view, (width, 3.0), most, names, sharey=True, sharex=grouped)
    log = is_log(view)
    for panel, facet in zip(grid.flat, view.panels, strict=False):
        here = set()
        for line in lines:
            points = view.of_line(facet, line.place)
            here |= set(points)
            _draw_means(panel, view, line, points, log)
            _draw_gone(panel, view, line, points)
        set_scale(panel, view.x, [value for value in view.x.values if value in here])
    _scale_means(grid[0, 0], view, len(lines), log)
    for panel in grid[:, 0]:
        panel.set_ylabel(view.y_label)
    for line in lines:
        of_line: list[Point] = []
        for facet in view.panels:
            of_line += view.of_line(facet, line.place).values()
        if not any(point.is_shown for point in of_line):
            what = "no flight was completed"
            if all(point.invalid for point in of_line):
                what = "invalid"
            grid[0, 0].plot([], [], label=f"{line.name} ({what})".strip(), **line.cross)
    if len(lines) > 1:
        figure.legend(*entries(grid.flat), loc="outside lower center", ncols=columns)
    return figure


def label_of(view: View, line: Place, names: Mapping[str, str]) -> str:
    """The text of a line in the legend, beginning with its controller. A checkpoint is named where a controller has
    several. names: see `View.named`."""
    parts = []
    for k, (key, value) in enumerate(zip(view.by, line, strict=True)):
        if key == "model":
            alike = {other[k] for other in view.lines() if _without(other, k) == _without(line, k)}
            if len(alike) == 1 and "controller" in view.by:
                continue
            text = view.title((key,), (value,))
            if not text and "controller" not in view.by:
                text = "no checkpoint"
        elif key == "controller":
            text = str(value)
        else:
            name = names.get(key, key.rpartition(".")[2])
            text = f"{name}={value} {unit_of(key)}".strip()
        parts.append(names.get(value_text(key, value), text))
    return " ".join(filter(None, parts))


def _without(place: Place, k: int) -> Place:
    return place[:k] + place[k + 1 :]


def looks_of(view: View) -> dict[Place, Look]:
    """Line -> its look, which the controller decides; also one that all flights share."""
    labels = {line: label_of(view, line, {}) for line in view.lines()}
    if list(labels.values()) == [""] and "controller" in view.alone:
        labels = dict.fromkeys(labels, view.alone["controller"])
    look = looks(list(labels.values()))
    by_line = {}
    for line, label in labels.items():
        texts = [*map(value_text, view.by, line)] or [label]
        stated = [view.colours[text] for text in texts if text in view.colours]
        by_line[line] = replace(look[label], own=stated[0] if stated else "")
    return by_line


def _draw_means(panel: Any, view: View, line: Line, points: Mapping[Any, Point], log: bool) -> None:
    """Means, their bars, and how many flights were completed where some were lost."""
    shown = {}
    for value in view.x.values:
        if value in points and points[value].is_shown:
            shown[value] = points[value]
    if not shown:
        return
    look = line.look.points()
    if view.x.kind == "group":
        look["linestyle"] = "none"
    x = np.array([place_of(view.x, value, line) for value in shown])
    mean, low, high = view.factor * np.array([(point.mean, point.low, point.high) for point in shown.values()]).T
    low = np.maximum(low, LEAST_SEEN if log else -math.inf)
    bars = np.maximum([mean - low, high - mean], 0.0)

    def draw(some: Any, label: str, look: Mapping[str, Any]) -> None:
        yerr = bars[:, some] if np.isfinite(bars[:, some]).any() else None
        panel.errorbar(x[some], mean[some], yerr=yerr, label=label, capsize=2.5, elinewidth=1.0, **look)

    if view.x.key == "controller" and not view.by:  # each with the look that it has everywhere
        look_of = looks([str(value) for value in view.x.values])
        for i, value in enumerate(map(str, shown)):
            draw([i], "", replace(look_of[value], own=view.colours.get(value, "")).points())
    else:
        draw(slice(None), line.name, look)
    for at, y, point in zip(x, mean, shown.values(), strict=True):
        if point.ended < point.trials:
            text = f"{point.ended}/{point.trials}"
            panel.annotate(text, (at, y), (4, 5), textcoords="offset points", fontsize=7, color=line.look.colour)


def _draw_gone(panel: Any, view: View, line: Line, points: Mapping[Any, Point]) -> None:
    """A cross above the lines where no flight of a place was completed, or its settings are invalid."""
    edge = panel.get_xaxis_transform()
    height = HIGHEST - BETWEEN * (line.k % LEVELS)
    for value, point in points.items():
        if not point.is_shown:
            at = (place_of(view.x, value, line), height)
            panel.plot(*at, transform=edge, clip_on=False, **line.cross)
            text = "invalid" if point.invalid else f"{point.ended}/{point.trials}"
            panel.annotate(
                text,
                at,
                (5, 0),
                xycoords=edge,
                textcoords="offset points",
                va="center",
                fontsize=6.5,
                color=line.look.colour,
            )


def place_of(axis: Axis, value: Any, line: Line) -> float:
    """Where a value of a line stands on an axis; the places of a group side by side."""
    if axis.kind == "number":
        return float(value)
    return axis.values.index(value) + line.shift


def _scale_means(panel: Any, view: View, n_lines: int, log: bool) -> None:
    """Scale, ticks and limits of y, which all panels share; where crosses stand, with room for them above."""
    shown = [point for point in view.places.values() if point.is_shown]
    if log:
        panel.set_yscale("log")
        seen = []
        for point in shown:
            seen.append(point.low if point.low > 0.1 * point.mean else point.mean)
        panel.set_ylim(bottom=0.8 * view.factor * min(seen))
    elif all(point.mean >= 0 for point in shown):
        largest = max(max(point.mean, point.high, 0) for point in shown)
        panel.set_ylim(0, 1.08 * view.factor * largest or 1.0)
    if len(shown) < len(view.places):
        low, high = panel.get_ylim()
        share = 1.0 / (0.92 - BETWEEN * min(n_lines, LEVELS))
        top = low * (high / low) ** share if log else low + (high - low) * share
        panel.set_ylim(top=top)
    if log:
        plain_log(panel.yaxis, minor=True)
    elif view.y == SUCCESS:
        panel.set_yticks(range(0, 101, 20))


def set_scale(panel: Any, axis: Axis, here: Sequence[Any]) -> None:
    """Scale, ticks and limits of x: a tick at every value as far as they have room. here: the values of the panel."""
    if axis.kind == "group":
        texts = [axis.text(value) for value in axis.values]
        panel.set_xticks(range(len(texts)), [_in_lines(text, 14) for text in texts])
        panel.set_xlim(-0.6, len(texts) - 0.4)
        panel.grid(False, axis="x")
        if sum(map(len, texts)) > 34:
            panel.tick_params(axis="x", rotation=30)
            for text in panel.get_xticklabels():
                text.set_horizontalalignment("right")
        return
    values = [float(value) for value in here]
    if axis.scale == "log":
        panel.set_xscale("log")
        panel.set_xticks(values[:: math.ceil(len(values) / MOST_TICKS)])
        panel.set_xticks(values, minor=True)
    else:
        ticks = values[:1]
        for value in values[1:]:
            if value - ticks[-1] >= APART * (values[-1] - values[0]):
                ticks.append(value)
        panel.set_xticks(ticks)
        panel.set_xticks([], minor=True)
    panel.xaxis.set_major_formatter(PLAIN)
    panel.xaxis.set_minor_formatter(lambda value, _: "")
    panel.margins(x=0.08)


def _in_lines(text: str, width: int) -> str:
    """A text in lines of about that many letters, broken behind /, + and commas, and never within a word."""
    lines = [""]
    for part in re.findall(r"[^/+,;]+[/+,;]?|[/+,;]", text):
        if lines[-1] and len(lines[-1]) + len(part) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)
