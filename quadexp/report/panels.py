"""Figures from records: a figure is rows of panels, a panel is its marks and the words at its axes.

A mark names a method of matplotlib's Axes and what that takes, so that a figure is said before it is drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LogNorm

from quadexp.report.style import COUNTS, Figure, entries, plain_log, styled


class Mark(NamedTuple):
    """kind: "plot", "step", "fill_between", "bar", "axhline", "hexbin", ...: a method of Axes. values, look: its
    arguments."""

    kind: str
    values: tuple[Any, ...]
    look: Mapping[str, Any]


def mark(kind: str, *values: Any, **look: Any) -> Mark:
    """A mark in the words of matplotlib: mark("plot", x, y, color="black", label="mean")."""
    return Mark(kind, values, look)


def density(x: np.ndarray, y: np.ndarray, extent: Sequence[float], cells: tuple[int, int]) -> Mark:
    """How many data lie where, darker where denser. extent: (x low, x high, y low, y high). cells: across and up."""
    return mark("hexbin", x, y, extent=tuple(extent), gridsize=cells, mincnt=1, cmap=COUNTS, norm=LogNorm(),
                linewidths=0.1, zorder=1)  # fmt: skip


@dataclass(frozen=True)
class Panel:
    """axes: keywords of `Axes.set`, as xlabel, ylim, yscale. legend: keywords of `Axes.legend`, None without one.
    math: whether what stands between $ in its texts is mathematics."""

    marks: Sequence[Mark]
    axes: Mapping[str, Any] = field(default_factory=dict)
    legend: Mapping[str, Any] | None = None
    math: bool = False

    def draw(self, place: Any) -> None:
        """Draw it into Axes."""
        for kind, values, look in self.marks:
            getattr(place, kind)(*values, **look)
        place.set(**self.axes)
        if self.axes.get("yscale") == "log":
            plain_log(place.yaxis)
        texts = [place.xaxis.label, place.yaxis.label, place.title, *place.get_xticklabels()]
        if self.legend is not None:
            texts += place.legend(**self.legend).get_texts()
        for text in texts if self.math else ():
            text.set_parse_math(True)


@styled
def panel_figure(
    rows: Sequence[Sequence[Panel | None]], size: tuple[float, float], *, legend: bool = False, **grid: Any
) -> Figure:
    """A figure of rows of panels. None leaves a place empty; a panel in several rows is as high as these, and the last
    one of a short row as wide as the rest.

    size: of the figure (inches). legend: one of all panels above them. grid: keywords of `subplot_mosaic`.
    """
    figure = Figure(figsize=size, layout="constrained")
    panels = {id(panel): panel for row in rows for panel in row if panel is not None}
    most = max(map(len, rows))
    names = [[id(row[min(j, len(row) - 1)]) for j in range(most)] for row in rows]
    places: Any = figure.subplot_mosaic([[name if name in panels else "." for name in row] for row in names], **grid)
    for name, panel in panels.items():
        panel.draw(places[name])
    if legend:
        handles, labels = entries(places.values())
        figure.legend(handles, labels, loc="outside upper center", ncols=min(6, len(labels)))
    return figure
