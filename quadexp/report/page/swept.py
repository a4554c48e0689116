"""The page's figures over the keys that were swept: those that `quadexp plot` draws without keys, a tab a quantity.

Lines are drawn in the colours of the page's theme; what a scale of colours stands for (heat maps, parallel coordinates)
is drawn on white in both themes. A figure of too many marks for a drawing becomes a picture of points (PNG).
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import matplotlib

from quadexp.errors import UsageError
from quadexp.messages import html
from quadexp.report.draw import figure_of
from quadexp.report.frame import SweepFrame
from quadexp.report.page.palette import PAGE, TOKENS, inline_svg
from quadexp.report.page.source import TABLED, Comparison
from quadexp.report.points import SUCCESS
from quadexp.report.style import Figure
from quadexp.report.view import View, automatic

LARGEST_DRAWING = 150_000  # characters of one figure as a drawing
BUDGET = 500_000  # characters of all of them
DOTS = 100  # of a picture, an inch
# Colours that figures of lines are drawn in on paper -> variable of the page's theme.
THEMED = {light: name for name, (light, _) in TOKENS.items() if name.startswith("series-")}
THEMED |= {"#ffffff": "ground", "#dddddd": "rule"}


@dataclass
class Swept:
    """Figures by quantity: (name, title, figures as HTML). left: what is not on the page. views: of the main one."""

    tabs: list[tuple[str, str, list[str]]] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    views: list[View] = field(default_factory=list)


def swept_figures(comparison: Comparison) -> Swept:
    """The figures that were chosen by what was swept."""
    made = Swept()
    frame = SweepFrame.read(comparison.root)
    room = BUDGET
    for metric in dict.fromkeys((comparison.metric, *TABLED, SUCCESS)):
        try:
            views = automatic(frame, metric, comparison.confidence)
        except UsageError:  # no flight has it
            continue
        made.views = made.views or views
        figures = [_figure(view, f"swept-{metric}-{i}") for i, view in enumerate(views)]
        kept = _within(figures, room)
        room -= sum(map(len, kept))
        if kept:
            made.tabs.append((metric, views[0].y_label, kept))
        if len(kept) < len(figures):
            files = ", ".join(view.file_name.replace("_", " ") for view in views[len(kept) :])
            made.left.append(f"{views[0].y_label} {files}, which `quadexp plot` draws")
    return made


def swept_paper(swept: Swept) -> dict[str, Figure]:
    """Name -> figure of the main quantity, for a paper."""
    return {f"{view.y.removesuffix('_error')}_error_{view.file_name}": figure_of(view) for view in swept.views}


def _within(figures: Sequence[str], room: int) -> list[str]:
    """The first figures that fit."""
    kept: list[str] = []
    for figure in figures:
        room -= len(figure)
        if room < 0:
            break
        kept.append(figure)
    return kept


def _figure(view: View, name: str) -> str:
    """A figure as HTML: what it shows is its caption and its description for screen readers."""
    themed = view.kind == "lines"
    label = f"{view.y_label}, {view.file_name.replace('_', ' ')}. {view.caption}"
    colours: Any = {"figure.facecolor": "none", "axes.facecolor": "none"} if themed else {}
    if themed:
        ink = ("text.color", "axes.titlecolor", "legend.labelcolor")
        quiet = ("axes.labelcolor", "xtick.color", "ytick.color", "axes.edgecolor")
        colours |= dict.fromkeys(ink, PAGE.ink) | dict.fromkeys(quiet, PAGE.muted)
    with matplotlib.rc_context(colours):
        figure = figure_of(view)
        drawing = inline_svg(figure, name, label, THEMED if themed else {})
    kind = "" if themed else ' class="plate"'
    wide = figure.get_size_inches()[0]
    if len(drawing) > LARGEST_DRAWING:
        drawing, kind = _picture(view, label), ' class="plate"'
    return f'<figure{kind} style="--wide:{wide:.1f}">{drawing}</figure>'


def _picture(view: View, label: str) -> str:
    stream = io.BytesIO()
    figure_of(view).savefig(stream, format="png", dpi=DOTS)
    data = base64.b64encode(stream.getvalue()).decode()
    return f'<img alt="{html(label)}" src="data:image/png;base64,{data}">'
