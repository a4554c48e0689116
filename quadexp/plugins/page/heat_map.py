"""A heat map: one key along x, one along y, the mean as a colour and as a number.

What was not asked for is blank, what is invalid crossed out; without a completed flight it says how many were lost.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.patches import Rectangle

from quadexp.plugins.drawing.style import ERROR_COLOURS, Figure, error_bar
from quadexp.plugins.page.panel_grid import is_log, panel_grid
from quadexp.plugins.page.places import Place, Point
from quadexp.plugins.page.view import Axis, View
from quadexp.report.text import significant

MOST_NUMBERS = 400  # cells of a map that have their number written into them
EMPTY = "#F2F2F2"
DARK = 0.34  # of the scale of colours, from where white has more contrast than black
LONGEST_TICK = 20  # letters, beside a map


def heat_map(view: View) -> Figure:
    by = Axis.of(view.by[0], [line[0] for line in view.lines()])
    rows = replace(by, names=view.names)
    n_rows = len(rows.values)
    n_columns = len(view.x.values)
    cell = 0.62 if n_columns * n_rows <= MOST_NUMBERS else 0.2  # inches
    size = max(2.2, cell * n_columns + 1.0), max(1.6, 0.42 * n_rows + 0.8)
    figure, grid, _ = panel_grid(view, size, 3)
    means = [view.factor * point.mean for point in view.places.values() if point.is_shown]
    least = min(means)
    largest = max(means)
    norm = LogNorm(least, largest) if is_log(view) else Normalize(least, largest or 1.0)
    for panel, facet in zip(grid.flat, view.panels, strict=False):
        _draw_map(panel, view, facet, rows, norm)
    for panel in grid[:, 0]:
        panel.set_ylabel(rows.label)
    error_bar(figure, norm, grid, view.y_label, shrink=0.9)
    return figure


def _draw_map(panel: Any, view: View, facet: Place, rows: Axis, norm: Normalize) -> None:
    means = np.full((len(rows.values), len(view.x.values)), np.nan)
    points = {}
    for j, row in enumerate(rows.values):
        for value, point in view.of_line(facet, (row,)).items():
            i = view.x.values.index(value)
            points[j, i] = point
            means[j, i] = view.factor * point.mean
    panel.set_facecolor(EMPTY)
    panel.imshow(np.ma.masked_invalid(means), cmap=ERROR_COLOURS, norm=norm, aspect="auto", origin="lower")
    panel.grid(False)
    panel.xaxis.set_ticks(range(len(view.x.values)), _tick_texts(view.x))
    panel.yaxis.set_ticks(range(len(rows.values)), _tick_texts(rows))
    if sum(map(len, map(view.x.text, view.x.values))) > 5 * len(view.x.values):
        panel.tick_params(axis="x", rotation=30)
    for (j, i), point in points.items():
        if not point.is_shown:
            corner = (i - 0.5, j - 0.5)
            panel.add_patch(Rectangle(corner, 1, 1, fill=False, hatch="///", edgecolor="#CCCCCC", linewidth=0))
        if means.size <= MOST_NUMBERS:
            colour = "#444444"
            if point.is_shown:
                colour = "#FFFFFF" if norm(means[j, i]) > DARK else "#000000"
            panel.text(i, j, _cell(point, means[j, i]), ha="center", va="center", fontsize=7, color=colour)


def _tick_texts(axis: Axis) -> list[str]:
    texts = map(axis.text, axis.values)
    return [text if len(text) <= LONGEST_TICK else f"{text[: LONGEST_TICK - 3]}..." for text in texts]


def _cell(point: Point, mean: float) -> str:
    """What stands in a cell."""
    if not point.trials:
        return "invalid"
    lost = f"{point.ended}/{point.trials}"
    if not point.is_shown:
        return f"{lost}\nflown"
    text = significant(mean)
    if point.ended < point.trials:
        return f"{text}\n{lost}"
    return text
