"""The page's figures over the keys that were swept: those that `quadexp plot` draws without keys, a tab a quantity.

Lines are drawn in the colours of the page's theme; what a scale of colours stands for (heat maps, parallel coordinates)
is drawn on white in both themes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from itertools import accumulate

from quadexp.errors import UsageError
from quadexp.report.draw import figure_of
from quadexp.report.frame import SweepFrame
from quadexp.report.page.sheet import figure_html
from quadexp.report.page.source import TABLED, Comparison
from quadexp.report.style import Figure
from quadexp.report.view import SUCCESS, View, automatic

BUDGET = 500_000  # characters of all figures


@dataclass
class Swept:
    """Figures by quantity: (name, title, figures as HTML). left: what is not on the page. views: of the main one."""

    tabs: list[tuple[str, str, list[str]]] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    views: list[View] = field(default_factory=list)

    def paper(self) -> dict[str, Figure]:
        """Name -> figure of the main quantity."""
        views = self.views
        return {f"{view.y.removesuffix('_error')}_error_{view.file_name}": figure_of(view) for view in views}


def swept_figures(comparison: Comparison) -> Swept:
    """The figures that were chosen by what was swept."""
    swept, frame, room = Swept(), SweepFrame.read(comparison.root), BUDGET
    for metric in dict.fromkeys((comparison.metric, *TABLED, SUCCESS)):
        try:
            views = automatic(frame, metric, comparison.confidence)
        except UsageError:  # no flight has it
            continue
        swept.views = swept.views or views
        figures = [_figure(view, f"swept-{metric}-{i}") for i, view in enumerate(views)]
        kept = sum(size <= room for size in accumulate(map(len, figures)))  # the first ones that fit
        room -= sum(map(len, figures[:kept]))
        if kept:
            swept.tabs.append((metric, views[0].y_label, figures[:kept]))
        if kept < len(figures):
            files = ", ".join(view.file_name.replace("_", " ") for view in views[kept:])
            swept.left.append(f"{views[0].y_label} {files}, which `quadexp plot` draws")
    return swept


def _figure(view: View, name: str) -> str:
    """What it shows is its caption and its description for screen readers."""
    label = f"{view.y_label}, {view.file_name.replace('_', ' ')}. {view.caption}"
    return figure_html(partial(figure_of, view), name, label, themed=view.kind == "lines")
