"""Lines over a key: a panel for every value of `facet`, a line for every value of `by`, bars for the interval.

Values of a key that is no number stand side by side, without lines between them. A place where flights were lost has
"k/n" beside it; one where none ended well has a cross at the upper edge.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quadexp.report.axes.points import SUCCESS, Place, Point
from quadexp.report.axes.view import Axis, View
from quadexp.report.style import PLAIN, Figure, Look, entries, looks, plain_log, styled

MAX_PANELS = 36
MAX_ACROSS = 4
WIDEST_LINEAR = 5.0  # ratio of the largest to the smallest mean, beyond which their axis is logarithmic
APART = 0.065  # share of a panel between two labels of ticks
SPREAD = 0.6  # of the room of a group, taken by its places side by side


@styled
def line_figure(view: View) -> Figure:
    """The figure of a view of kind "lines"."""
    panels, left = view.panels[:MAX_PANELS], view.panels[MAX_PANELS:]
    lines = view.lines()
    labels = {line: label_of(view, line) for line in lines}
    found = looks_of(view, lines)
    size = max(3.1, 0.42 * len(view.x.values)) if view.x.kind == "group" else 3.1  # inches, of a panel across
    across = min(len(panels), max(1, int(MAX_ACROSS * 3.1 / size)))
    down = math.ceil(len(panels) / across)
    width = max(5.6, 1.4 + size * across)
    columns = max(1, min(len(lines), int(13 * width / (max(map(len, labels.values()), default=1) + 6))))
    legend = 0.2 * math.ceil(len(lines) / columns) if len(lines) > 1 else 0
    figure = Figure(
        figsize=(width, 3.0 * down + 0.35 + legend + 0.17 * len(notes_of(view, left, width))), layout="constrained"
    )
    grid = figure.subplots(down, across, sharey=True, sharex=view.x.kind == "group", squeeze=False)
    log = is_log(view)
    for panel, facet in zip(grid.flat, panels, strict=False):
        for k, line in enumerate(lines):
            of_line = {value: view.places.get((*facet, *line, value)) for value in view.x.values}
            _draw_line(panel, view, of_line, found[labels[line]].points(), labels[line], (k, len(lines)), log)
        panel.set_title(textwrap.fill(view.title(view.facet, facet), 34))
        panel.set_xlabel(view.x.label)
        here = [value for value in view.x.values if any((*facet, *line, value) in view.places for line in lines)]
        set_scale(panel, view.x, here)
    for panel in grid.flat[len(panels) :]:
        panel.set_axis_off()
    if log:
        ends = [v for p in view.places.values() if p.is_shown for v in (p.mean, p.low) if v > 0.1 * p.mean]
        grid[0, 0].set_yscale("log")
        grid[0, 0].set_ylim(bottom=0.8 * view.factor * min(ends))
    elif all(point.mean >= 0 for point in view.places.values() if point.is_shown):
        largest = max(max(point.mean, max(0, point.high)) for point in view.places.values() if point.is_shown)
        grid[0, 0].set_ylim(0, 1.08 * view.factor * largest or 1.0)
    _make_room(grid[0, 0], view, len(lines), log)
    if log:
        plain_log(grid[0, 0].yaxis, minor=True)
    elif view.y == SUCCESS:
        grid[0, 0].set_yticks(range(0, 101, 20))
    for row in grid:
        row[0].set_ylabel(view.y_label)
    _mark_gone(grid.flat, panels, view, lines)
    if len(lines) > 1:
        figure.legend(*entries(grid.flat), loc="outside lower center", ncols=columns)
    caption(figure, view, left, width)
    return figure


def label_of(view: View, line: Place) -> str:
    """The text of a line in the legend, beginning with its controller, which decides its colour."""
    parts = []
    for key, value in zip(view.by, line, strict=True):
        if key == "model":
            parts.append(view.title((key,), (value,)) or ("" if "controller" in view.by else "no checkpoint"))
        else:
            parts.append(str(value) if key == "controller" else f"{key.rpartition('.')[2]}={value}")
    return " ".join(filter(None, parts))


def looks_of(view: View, lines: Sequence[Place]) -> dict[str, Look]:
    """Label of a line -> its look; one that all flights share with a controller has the look of that."""
    labels = [label_of(view, line) for line in lines]
    if len(labels) == 1 and not labels[0] and "controller" in view.alone:
        return {"": looks([view.alone["controller"]])[view.alone["controller"]]}
    return looks(labels)


def _draw_line(
    panel: Any, view: View, of_line: Mapping[Any, Point | None], look: Mapping[str, Any], label: str,
    beside: tuple[int, int], log: bool,
) -> None:  # fmt: skip
    there = [(value, point) for value, point in of_line.items() if point is not None and point.is_shown]
    if not there:
        return
    x = np.array([place_of(view.x, value, *beside) for value, _ in there])
    mean, low, high = (view.factor * np.array([getattr(p, name) for _, p in there]) for name in ("mean", "low", "high"))
    bars = np.maximum(np.vstack([mean - np.maximum(low, 1e-9 if log else -np.inf), high - mean]), 0.0)
    look = dict(look) | ({"linestyle": "none"} if view.x.kind == "group" else {})
    each: list[Any] = [(slice(None), label, look)]
    if view.x.key == "controller" and not view.by:  # each with the look that it has everywhere
        own = looks([str(value) for value in view.x.values])
        each = [([i], "", own[str(value)].points()) for i, (value, _) in enumerate(there)]
    for some, name, drawn in each:
        yerr = bars[:, some] if np.isfinite(bars[:, some]).any() else None
        panel.errorbar(x[some], mean[some], yerr=yerr, label=name, capsize=2.5, elinewidth=1.0, **drawn)
    for at, y, (_, point) in zip(x, mean, there, strict=True):
        if point.ended < point.trials:
            text = f"{point.ended}/{point.trials}"
            panel.annotate(text, (at, y), (4, 5), textcoords="offset points", fontsize=7, color=look["color"])


def place_of(axis: Axis, value: Any, k: int = 0, n: int = 1) -> float:
    """Where a value stands on an axis; the places of a group side by side, the k-th of n."""
    if axis.kind == "number":
        return float(value)
    return axis.values.index(value) + (SPREAD * ((k + 0.5) / n - 0.5) if n > 1 else 0.0)


def set_scale(panel: Any, axis: Axis, here: Sequence[Any]) -> None:
    """Scale, ticks and limits of x: a tick at every value as far as they have room. here: the values of the panel."""
    if axis.kind == "group":
        panel.set_xticks(range(len(axis.values)), [_in_lines(axis.text(v), 14) for v in axis.values])
        panel.set_xlim(-0.6, len(axis.values) - 0.4)
        if sum(map(len, map(axis.text, axis.values))) > 34:
            panel.tick_params(axis="x", rotation=30)
            for text in panel.get_xticklabels():
                text.set_horizontalalignment("right")
        panel.grid(False, axis="x")
        return
    values = [float(value) for value in here]
    if axis.scale == "log":
        panel.set_xscale("log")
    elif axis.scale == "symlog":
        panel.set_xscale("symlog", linthresh=min(value for value in axis.values if value > 0))
    shown = values if len(values) <= 8 else values[:: math.ceil(len(values) / 8)]
    if axis.scale == "linear":
        shown = [values[0]]
        for value in values[1:]:
            shown += [value] if value - shown[-1] >= APART * (values[-1] - values[0]) else []
    panel.set_xticks(shown)
    panel.set_xticks([] if axis.scale == "linear" else values, minor=True)
    panel.xaxis.set_major_formatter(PLAIN)
    panel.xaxis.set_minor_formatter(lambda value, _: "")
    if axis.scale != "symlog":
        panel.margins(x=0.08)


def _in_lines(text: str, width: int) -> str:
    """A text in lines of about that many letters, broken behind /, + and commas, and never within a word."""
    lines = [""]
    for part in re.findall(r"[^/+,;]+[/+,;]?|[/+,;]", text):
        if lines[-1] and len(lines[-1]) + len(part) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)


def is_log(view: View) -> bool:
    """Whether the means are shown on a logarithmic axis: positive, and far apart."""
    means = [point.mean for point in view.places.values() if point.is_shown]
    return min(means) > 0 and max(means) > WIDEST_LINEAR * min(means)


def _mark_gone(grid: Any, panels: Sequence[Place], view: View, lines: Sequence[Place]) -> None:
    """A cross above the lines where no flight of a place ended well, or its settings are invalid."""
    found = looks_of(view, lines)
    start = len(view.facet)
    for line in lines:
        own = [point for place, point in view.places.items() if place[start : start + len(line)] == line]
        if not any(point.is_shown for point in own):
            what = "invalid" if all(point.invalid for point in own) else "no flight ended well"
            label = f"{label_of(view, line)} ({what})".strip()
            colour = found[label_of(view, line)].colour
            grid[0].plot([], [], marker="x", markersize=5, linestyle="none", color=colour, label=label)
    for panel, facet in zip(grid, panels, strict=False):
        for k, line in enumerate(lines):
            colour = found[label_of(view, line)].colour
            for value in view.x.values:
                point = view.places.get((*facet, *line, value))
                if point is None or point.is_shown:
                    continue
                text = "invalid" if point.invalid else f"{point.ended}/{point.trials}"
                at, y, edge = (
                    place_of(view.x, value, k, len(lines)),
                    0.97 - 0.055 * (k % 5),
                    panel.get_xaxis_transform(),
                )
                panel.plot(at, y, marker="x", markersize=5, color=colour, transform=edge, clip_on=False)
                panel.annotate(
                    text, (at, y), (5, 0), xycoords=edge, textcoords="offset points", va="center", fontsize=6.5,
                    color=colour,
                )  # fmt: skip


def _make_room(panel: Any, view: View, lines: int, log: bool) -> None:
    """Leave the upper edge to the crosses of places where no flight ended well."""
    if all(point.is_shown for point in view.places.values()):
        return
    low, high = panel.get_ylim()
    share = 1.0 / (0.92 - 0.055 * min(lines, 5))
    panel.set_ylim(top=low * (high / low) ** share if log else low + (high - low) * share)


def notes_of(view: View, left: Sequence[Place], width: float) -> list[str]:
    """The lines above a figure: what its marks are, and what it leaves out."""
    gone = [view.title(view.facet, facet) for facet in left]
    dropped = [f"no room for {len(gone)} panels: {', '.join(gone)}"] if gone else []
    return [row for line in (view.caption, *view.notes, *dropped) for row in textwrap.wrap(line, int(15 * width))]


def caption(figure: Figure, view: View, left: Sequence[Place], width: float) -> None:
    figure.suptitle("\n".join(notes_of(view, left, width)), fontsize=8)
