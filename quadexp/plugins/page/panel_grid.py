"""The panels of a figure: its size, panels in a row, and the texts above and below them."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Collection
from typing import Any

from quadexp.plugins.drawing.style import Figure
from quadexp.plugins.page.view import View

LEAST_PANEL = 2.2  # inches, of the width of a panel on paper
MAX_PANELS = 36  # six by six: smaller ones have no room for their labels
WIDEST_LINEAR = 5.0  # ratio of the largest to the smallest mean, beyond which their axis is logarithmic
LETTERS = 13  # of a legend, an inch
MARK = 6  # letters that the mark of an entry of the legend takes


def panel_grid(
    view: View, size: tuple[float, float], most: int, labels: Collection[str] = (), **share: Any
) -> tuple[Figure, Any, int]:
    """A figure, its grid of panels, each with its title, and the columns of its legend.

    size: of a panel (inches). most: panels across. labels: of the legend. share: of axes."""
    panels = view.panels[:MAX_PANELS]
    across = min(len(panels), most)
    width = max(5.6, 1.4 + size[0] * across)
    height = size[1]
    lines = [view.heading, view.caption, *view.notes]
    if view.width:
        across = max(1, min(len(panels), int(view.width / LEAST_PANEL)))
        width = view.width
        height = min(height, 0.8 * width / across)
        lines = [view.heading]
    without = [view.title(view.facet, facet) for facet in view.panels[MAX_PANELS:]]
    if without:
        lines.append(f"no room for {len(without)} panels: {', '.join(without)}")
    above = []
    for line in lines:
        above += textwrap.wrap(line, int(15 * width))
    widest = max(map(len, labels), default=1) + MARK
    columns = max(1, min(len(labels), int(LETTERS * width / widest)))
    legend = 0.2 * math.ceil(len(labels) / columns) if len(labels) > 1 else 0.0
    down = math.ceil(len(panels) / across)
    whole = height * down + 0.4 + legend + 0.17 * len(above)
    figure = Figure(figsize=(width, view.height or whole))
    grid = figure.subplots(down, across, squeeze=False, **share)
    for panel, facet in zip(grid.flat, panels, strict=False):
        title = view.title(view.facet, facet)
        panel.set_title(textwrap.fill(title, max(12, int(11 * width / across))))
        panel.set_xlabel(view.x.label)
    n = len(panels)
    for panel in grid.flat[n:]:
        panel.set_axis_off()
    for panel in grid.flat[max(n - across, 0) : (down - 1) * across]:
        panel.tick_params(labelbottom=True)  # there is none below that would have the values
    figure.suptitle("\n".join(above), fontsize=8)
    return figure, grid, columns


def is_log(view: View) -> bool:
    """Whether the means are shown on a logarithmic axis: positive, and far apart."""
    means = [point.mean for point in view.places.values() if point.is_shown]
    return min(means) > 0 and max(means) > WIDEST_LINEAR * min(means)
