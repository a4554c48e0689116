"""The one drawer: a view as lines or as a heat map, with the mean of a metric over any keys.

lines      a panel for every value of `facet`, a line for every value of `by`, bars for the interval. Values of a key
           that is no number stand side by side. Where flights were lost stands "k/n"; where none completed, a cross at
           the upper edge
heat       one key along x, one along y, the mean as a colour and as a number. What was not asked for is blank, what is
           invalid crossed out; without a completed flight it says how many were lost

A file is PNG, PDF or SVG, or one HTML page with the numbers, which opens offline. With `View.width` it is for a paper:
as wide as a column or page of the IEEE with letters that fit it, and its notes are left to the caption.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.patches import Rectangle

from quadexp.errors import UsageError
from quadexp.log.store import read_flight
from quadexp.names import named
from quadexp.plugins.drawing.style import (
    ERROR_COLOURS,
    PLAIN,
    STYLE,
    Figure,
    Look,
    entries,
    error_bar,
    figure_html,
    looks,
    plain_log,
    save_figure,
)
from quadexp.plugins.page.differences import names_of
from quadexp.plugins.page.document import sortable_page
from quadexp.plugins.page.places import SUCCESS, Place, Point
from quadexp.plugins.page.view import Axis, View, value_text, view
from quadexp.report.frame import SweepFrame, read_results, unit_of
from quadexp.report.pairing import SOURCE
from quadexp.report.table import records_table
from quadexp.report.text import significant
from quadexp.writer import write_text

SUFFIXES = ("png", "pdf", "svg", "html")
ON_PAPER: Any = {  # letters of the size and kind of the text around: Times, in its free form
    "font.size": 8,
    "axes.titlesize": 8,
    "legend.fontsize": 7,
    "lines.linewidth": 1.2,
    "font.family": ["STIXGeneral", "DejaVu Sans"],
    "mathtext.fontset": "stix",
}
LEAST_PANEL = 2.2  # inches, of the width of a panel on paper
MAX_PANELS = 36  # six by six: smaller ones have no room for their labels
WIDEST_LINEAR = 5.0  # ratio of the largest to the smallest mean, beyond which their axis is logarithmic
APART = 0.065  # share of a panel between two labels of ticks
SPREAD = 0.6  # of the room of a group, taken by its places side by side
MOST_LETTERS = 400  # cells of a map that have their number written into them
EMPTY = "#F2F2F2"
DARK = 0.34  # of the scale of colours, from where white has more contrast than black
LONGEST_TICK = 20  # letters, beside a map


def figure_of(view: View) -> Figure:
    """The matplotlib figure of a view, on paper with smaller letters."""
    with matplotlib.rc_context({**STYLE, **(ON_PAPER if view.width else {})}):
        figure = _heat_map(view) if view.kind == "heat" else _lines(view)
        for panel in figure.axes if view.width else ():
            panel.tick_params(labelsize=ON_PAPER["legend.fontsize"])
    return figure


def _panels(view: View, size: tuple[float, float], most: int, room: float = 0, **share: Any) -> tuple[Figure, Any]:
    """A figure and its grid of panels, each with its title, and what its marks are above them.

    size: of a panel (inches). most: panels across. room: inches beside the panels, for a legend. share: of axes."""
    panels = view.panels[:MAX_PANELS]
    without = view.panels[MAX_PANELS:]
    across, width = _across(view, size[0], most)
    down = math.ceil(len(panels) / across)
    each = min(size[1], 0.8 * width / across) if view.width else size[1]
    gone = [view.title(view.facet, facet) for facet in without]
    dropped = [f"no room for {len(gone)} panels: {', '.join(gone)}"] if gone else []
    lines = filter(None, (view.heading, *(() if view.width else (view.caption, *view.notes)), *dropped))
    above = []
    for line in lines:
        above += textwrap.wrap(line, int(15 * width))
    figure = Figure(figsize=(width, view.height or each * down + 0.4 + room + 0.17 * len(above)))
    grid = figure.subplots(down, across, squeeze=False, **share)
    for panel, facet in zip(grid.flat, panels, strict=False):
        panel.set_title(textwrap.fill(view.title(view.facet, facet), max(12, int(11 * width / across))))
        panel.set_xlabel(view.x.label)
    for panel in grid.flat[len(panels) :]:
        panel.set_axis_off()
    for panel in grid.flat[max(len(panels) - across, 0) : (down - 1) * across]:
        panel.tick_params(labelbottom=True)  # there is none below that would have the values
    figure.suptitle("\n".join(above), fontsize=8)
    return figure, grid


def _across(view: View, size: float, most: int) -> tuple[int, float]:
    """Panels side by side, and the width of the figure (inches). size: of a panel."""
    panels = min(len(view.panels), MAX_PANELS)
    if view.width:
        return max(1, min(panels, int(view.width / LEAST_PANEL))), view.width
    across = min(panels, most)
    return across, max(5.6, 1.4 + size * across)


def _lines(view: View) -> Figure:
    lines = view.lines()
    look = looks_of(view)
    labels = {line: label_of(view, line, view.names) for line in lines}
    size = max(3.1, 0.42 * len(view.x.values)) if view.x.kind == "group" else 3.1
    most = max(1, int(12.4 / size))
    width = _across(view, size, most)[1]
    columns = max(1, min(len(lines), int(13 * width / (max(map(len, labels.values()), default=1) + 6))))
    legend = 0.2 * math.ceil(len(lines) / columns) if len(lines) > 1 else 0
    figure, grid = _panels(view, (size, 3.0), most, legend, sharey=True, sharex=view.x.kind == "group")
    log = is_log(view)
    for panel, facet in zip(grid.flat, view.panels, strict=False):
        for k, line in enumerate(lines):
            of_line = {value: view.places.get((*facet, *line, value)) for value in view.x.values}
            _draw_line(panel, view, of_line, look[line].points(), labels[line], (k, len(lines)), log)
        set_scale(panel, view.x, [v for v in view.x.values if any((*facet, *line, v) in view.places for line in lines)])
    shown = [point for point in view.places.values() if point.is_shown]
    first = grid[0, 0]
    if log:
        first.set_yscale("log")
        first.set_ylim(bottom=0.8 * view.factor * min(v for p in shown for v in (p.mean, p.low) if v > 0.1 * p.mean))
    elif all(point.mean >= 0 for point in shown):
        largest = max(max(point.mean, point.high, 0) for point in shown)
        first.set_ylim(0, 1.08 * view.factor * largest or 1.0)
    if len(shown) < len(view.places):  # the upper edge is left to crosses
        low, high = first.get_ylim()
        share = 1.0 / (0.92 - 0.055 * min(len(lines), 5))
        first.set_ylim(top=low * (high / low) ** share if log else low + (high - low) * share)
    if log:
        plain_log(first.yaxis, minor=True)
    elif view.y == SUCCESS:
        first.set_yticks(range(0, 101, 20))
    for row in grid:
        row[0].set_ylabel(view.y_label)
    _mark_gone(list(grid.flat), view, look, labels)
    if len(lines) > 1:
        figure.legend(*entries(grid.flat), loc="outside lower center", ncols=columns)
    return figure


def label_of(view: View, line: Place, names: Mapping[str, str]) -> str:
    """The text of a line in the legend, beginning with its controller. A checkpoint is named where a controller has
    several. names: see `View.named`."""
    parts = []
    for k, (key, value) in enumerate(zip(view.by, line, strict=True)):
        if key == "model":
            alike = set()
            for other in view.lines():
                if other[:k] + other[k + 1 :] == line[:k] + line[k + 1 :]:
                    alike.add(other[k])
            if len(alike) == 1 and "controller" in view.by:
                continue
            text = view.title((key,), (value,)) or ("" if "controller" in view.by else "no checkpoint")
        elif key == "controller":
            text = str(value)
        else:
            text = f"{names.get(key, key.rpartition('.')[2])}={value} {unit_of(key)}".strip()
        parts.append(names.get(value_text(key, value), text))
    return " ".join(filter(None, parts))


def looks_of(view: View) -> dict[Place, Look]:
    """Line -> its look, which the controller decides; also one that all flights share."""
    labels = {line: label_of(view, line, {}) for line in view.lines()}
    if list(labels.values()) == [""] and "controller" in view.alone:
        labels = dict.fromkeys(labels, view.alone["controller"])
    look = looks(list(labels.values()))
    by_line = {}
    for line, label in labels.items():
        texts = [value_text(key, value) for key, value in zip(view.by, line, strict=True)] or [label]
        colour = next((view.colours[text] for text in texts if text in view.colours), "")
        by_line[line] = replace(look[label], own=colour)
    return by_line


def _draw_line(
    panel: Any,
    view: View,
    of_line: Mapping[Any, Point | None],
    look: Mapping[str, Any],
    label: str,
    beside: tuple[int, int],
    log: bool,
) -> None:
    there = [(value, point) for value, point in of_line.items() if point is not None and point.is_shown]
    if not there:
        return
    x = np.array([place_of(view.x, value, *beside) for value, _ in there])
    mean, low, high = (view.factor * np.array([getattr(p, name) for _, p in there]) for name in ("mean", "low", "high"))
    bars = np.maximum(np.vstack([mean - np.maximum(low, 1e-9 if log else -np.inf), high - mean]), 0.0)
    look = dict(look) | ({"linestyle": "none"} if view.x.kind == "group" else {})
    each: list[Any] = [(slice(None), label, look)]
    if view.x.key == "controller" and not view.by:  # each with the look that it has everywhere
        look_of = looks([str(value) for value in view.x.values])
        look_of = {name: replace(usual, own=view.colours.get(name, "")) for name, usual in look_of.items()}
        each = [([i], "", look_of[str(value)].points()) for i, (value, _) in enumerate(there)]
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
    shown = values if len(values) <= 8 else values[:: math.ceil(len(values) / 8)]
    if axis.scale == "linear":
        shown = [values[0]]
        for value in values[1:]:
            shown += [value] if value - shown[-1] >= APART * (values[-1] - values[0]) else []
    panel.set_xticks(shown)
    panel.set_xticks([] if axis.scale == "linear" else values, minor=True)
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


def is_log(view: View) -> bool:
    """Whether the means are shown on a logarithmic axis: positive, and far apart."""
    means = [point.mean for point in view.places.values() if point.is_shown]
    return min(means) > 0 and max(means) > WIDEST_LINEAR * min(means)


def _mark_gone(grid: Any, view: View, look: Mapping[Place, Look], labels: Mapping[Place, str]) -> None:
    """A cross above the lines where no flight of a place was completed, or its settings are invalid."""
    start = len(view.facet)
    for k, (line, label) in enumerate(labels.items()):
        cross = {"marker": "x", "markersize": 5, "color": look[line].colour, "linestyle": "none"}
        of_line = {place: point for place, point in view.places.items() if place[start : start + len(line)] == line}
        if not any(point.is_shown for point in of_line.values()):
            what = "invalid" if all(point.invalid for point in of_line.values()) else "no flight was completed"
            grid[0].plot([], [], label=f"{label} ({what})".strip(), **cross)
        for panel, facet in zip(grid, view.panels, strict=False):
            gone = [(p[-1], point) for p, point in of_line.items() if p[:start] == facet and not point.is_shown]
            for value, point in gone:
                at = (place_of(view.x, value, k, len(labels)), 0.97 - 0.055 * (k % 5))
                edge = panel.get_xaxis_transform()
                panel.plot(*at, transform=edge, clip_on=False, **cross)
                text = "invalid" if point.invalid else f"{point.ended}/{point.trials}"
                beside = {"xytext": (5, 0), "textcoords": "offset points", "va": "center", "fontsize": 6.5}
                panel.annotate(text, at, xycoords=edge, color=look[line].colour, **beside)


def _heat_map(view: View) -> Figure:
    down_axis = replace(Axis.of(view.by[0], [line[0] for line in view.lines()]), names=view.names)
    cell = 0.62 if len(view.x.values) * len(down_axis.values) <= MOST_LETTERS else 0.2
    size = max(2.2, cell * len(view.x.values) + 1.0), max(1.6, 0.42 * len(down_axis.values) + 0.8)
    figure, grid = _panels(view, size, 3)
    means = [view.factor * point.mean for point in view.places.values() if point.is_shown]
    norm = LogNorm(min(means), max(means)) if is_log(view) else Normalize(min(means), max(means) or 1.0)
    for panel, facet in zip(grid.flat, view.panels, strict=False):
        _draw_map(panel, view, facet, down_axis, norm)
    for line in grid:
        line[0].set_ylabel(down_axis.label)
    error_bar(figure, norm, grid, view.y_label, shrink=0.9)
    return figure


def _draw_map(panel: Any, view: View, facet: Place, down_axis: Axis, norm: Normalize) -> None:
    points = []
    for row in down_axis.values:
        points.append([view.places.get((*facet, row, column)) for column in view.x.values])
    values = np.array([[view.factor * point.mean if point else math.nan for point in row] for row in points])
    panel.set_facecolor(EMPTY)
    panel.imshow(np.ma.masked_invalid(values), cmap=ERROR_COLOURS, norm=norm, aspect="auto", origin="lower")
    panel.grid(False)
    for axis, place in ((view.x, panel.xaxis), (down_axis, panel.yaxis)):
        texts = [axis.text(value) for value in axis.values]
        texts = [text if len(text) <= LONGEST_TICK else f"{text[: LONGEST_TICK - 3]}..." for text in texts]
        place.set_ticks(range(len(texts)), texts)
    if sum(map(len, map(view.x.text, view.x.values))) > 5 * len(view.x.values):
        panel.tick_params(axis="x", rotation=30)
    for (j, i), value in np.ndenumerate(values):
        point = points[j][i]
        if point is None:
            continue
        lines = [f"{point.ended}/{point.trials}"] if point.ended < point.trials else []
        colour = "#444444"
        if point.is_shown:
            lines = [significant(value), *lines]
            colour = "#FFFFFF" if norm(value) > DARK else "#000000"
        else:
            lines = [*lines, "flown"] if lines else ["invalid"]
            hatch = Rectangle((i - 0.5, j - 0.5), 1, 1, fill=False, hatch="///", edgecolor="#CCCCCC", linewidth=0)
            panel.add_patch(hatch)
        if values.size <= MOST_LETTERS:
            panel.text(i, j, "\n".join(lines), ha="center", va="center", fontsize=7, color=colour)


def records(view: View) -> list[dict[str, Any]]:
    """The numbers behind a view, a record a place: its keys, and mean, low, high in SI units."""
    rows = []
    for place, point in view.places.items():
        keys = named(view.keys, place)
        about = {"seeds": point.seeds, "flights": point.flights, "ended": point.ended, "trials": point.trials}
        numbers = {view.y: point.mean, "low": point.low, "high": point.high, "interval": point.method}
        rows.append({**keys, **numbers, **about, "invalid": point.invalid})
    return rows


def save_view(view: View, path: Path, title: str = "", *, force: bool = True) -> Path:
    """Write the figure of a view in the format that the path's suffix names."""
    if path.suffix.lower() == ".html":
        return write_text(path, page_of(view, title), force=force)
    return save_figure(figure_of(view), path, force=force)


def page_of(view: View, title: str) -> str:
    """The figure with its numbers as one page that opens without a network."""
    shown = []
    for row in records(view):
        shown.append({**row, **{n: view.factor * row[n] for n in (view.y, "low", "high")}})
    rows = []
    for row in shown:
        rows.append({n: float(f"{v:.6g}") if isinstance(v, float) else v for n, v in row.items()})
    table = records_table(rows)
    heads = [f"{name} ({view.unit})" if name == view.y and view.unit else name for name in table.columns]
    heading = view.heading or title or view.y_label
    notes = (view.caption, *view.notes)
    figure = figure_html(figure_of(view), heading)
    return sortable_page(heading, replace(table, columns=heads), figures=[figure], notes=notes)


def comparison_figure(kind: str, paths: Sequence[Path]) -> Figure:
    """Paths and errors of several flights, or errors of several results; UsageError where there is nothing to draw."""
    if kind == "flight":
        from quadexp.plugins.page.flight_figures import flights_figure

        return flights_figure(named(names_of(paths), map(read_flight, paths)))
    if kind == "results":
        return results_figure(paths)
    raise UsageError("--out: draws flights and results; the scores of checkpoints are in the table")


def results_figure(paths: Sequence[Path]) -> Figure:
    """Errors of every results folder, a line each: over the key with most values, a panel a controller and path."""
    rows: list[dict[str, Any]] = []
    record: dict[str, Any] = {}
    for path, name in zip(paths, names_of(paths), strict=True):
        _, flights, about = read_results(path)
        record = record or {key: about[key] for key in ("metric", "confidence") if key in about}
        for row in flights:
            variant = f"{row.get('variant') or ''} {SOURCE}={name}".strip()
            rows.append({**row, "variant": variant})
    frame = SweepFrame(rows, paths[0], record)
    axes = [key for key in frame.swept if key not in (SOURCE, "controller", "model", "trajectory", "seed")]
    x = max(axes, key=lambda key: len(frame.values(key))) if axes else "controller"
    return figure_of(view(frame, x=x, by=[SOURCE], y=str(record.get("metric", "mean_error"))))
