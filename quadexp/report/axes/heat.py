"""A heat map: one key along x, one along y, the mean as a colour and as a number; a panel for every value of `facet`.

A cell that was not asked for is blank, an invalid one is crossed out and says so, and one without a flight that ended
well says how many were lost.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.patches import Rectangle

from quadexp.report.axes.lines import MAX_PANELS, caption, is_log, notes_of
from quadexp.report.axes.points import Place
from quadexp.report.axes.view import Axis, View
from quadexp.report.figures import ERROR_COLOURS
from quadexp.report.style import Figure, plain_log, styled
from quadexp.report.text import significant

MAX_ACROSS = 3
MOST_LETTERS = 400  # cells of a panel that have their number written into them
EMPTY = "#F2F2F2"


@styled
def heat_figure(view: View) -> Figure:
    """The figure of a view of kind "heat"."""
    (rows,) = view.by
    down_axis = Axis.of(rows, [line[0] for line in view.lines()])
    panels, left = view.panels[:MAX_PANELS], view.panels[MAX_PANELS:]
    across = min(len(panels), MAX_ACROSS)
    down = math.ceil(len(panels) / across)
    cell = 0.62 if len(view.x.values) * len(down_axis.values) <= MOST_LETTERS else 0.2
    size = max(2.2, cell * len(view.x.values) + 1.0), max(1.6, 0.42 * len(down_axis.values) + 0.8)
    width = max(5.6, 1.0 + size[0] * across)
    figure = Figure(
        figsize=(width, size[1] * down + 0.4 + 0.17 * len(notes_of(view, left, width))), layout="constrained"
    )
    grid = figure.subplots(down, across, squeeze=False)
    means = [view.factor * point.mean for point in view.places.values() if point.is_shown]
    norm = LogNorm(min(means), max(means)) if is_log(view) else Normalize(min(means), max(means) or 1.0)
    image: Any = None
    for panel, facet in zip(grid.flat, panels, strict=False):
        image = _draw(panel, view, facet, down_axis, norm)
        panel.set_title(textwrap.fill(view.title(view.facet, facet), 34))
        panel.set_xlabel(view.x.label)
    for panel in grid.flat[len(panels) :]:
        panel.set_axis_off()
    for line in grid:
        line[0].set_ylabel(down_axis.label)
    bar = figure.colorbar(image, ax=grid, label=view.y_label, shrink=0.9)
    if isinstance(norm, LogNorm):
        plain_log(bar.ax.yaxis)
    caption(figure, view, left, width)
    return figure


def table_of(view: View, facet: Place, down_axis: Axis) -> np.ndarray:
    """The means of a panel in the unit shown, (rows, columns), NaN where there is none."""
    values = np.full((len(down_axis.values), len(view.x.values)), math.nan)
    for j, row in enumerate(down_axis.values):
        for i, column in enumerate(view.x.values):
            point = view.places.get((*facet, row, column))
            values[j, i] = view.factor * point.mean if point is not None else math.nan
    return values


def readable_on(colour: Sequence[float]) -> str:
    """Black or white, whichever has more contrast on a colour (red, green, blue in [0, 1]), as WCAG defines it."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour[:3]]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    return "#000000" if (luminance + 0.05) ** 2 > 1.05 * 0.05 else "#FFFFFF"


def _draw(panel: Any, view: View, facet: Place, down_axis: Axis, norm: Normalize) -> Any:
    values = table_of(view, facet, down_axis)
    panel.set_facecolor(EMPTY)
    image = panel.imshow(np.ma.masked_invalid(values), cmap=ERROR_COLOURS, norm=norm, aspect="auto", origin="lower")
    panel.grid(False)
    for axis, place in ((view.x, panel.xaxis), (down_axis, panel.yaxis)):
        place.set_ticks(
            range(len(axis.values)), [textwrap.shorten(axis.text(v), 18, placeholder="...") for v in axis.values]
        )
    if sum(map(len, map(view.x.text, view.x.values))) > 5 * len(view.x.values):
        panel.tick_params(axis="x", rotation=30)
    written = values.size <= MOST_LETTERS
    for j, row in enumerate(down_axis.values):
        for i, column in enumerate(view.x.values):
            point = view.places.get((*facet, row, column))
            if point is None:
                continue
            text, colour = significant(values[j, i]) if point.is_shown else "", "#FFFFFF"
            if point.is_shown:
                colour = readable_on(ERROR_COLOURS(norm(values[j, i])))
            if point.ended < point.trials:
                text += f"\n{point.ended}/{point.trials}" if text else f"{point.ended}/{point.trials}\nflown"
            if not point.is_shown:
                text, colour = text or "invalid", "#444444"
                hatch = Rectangle((i - 0.5, j - 0.5), 1, 1, fill=False, hatch="///", edgecolor="#CCCCCC", linewidth=0)
                panel.add_patch(hatch)
            if written:
                panel.text(i, j, text, ha="center", va="center", fontsize=7, color=colour)
    return image
