"""Figures of the page: panels that belong together, as SVG in the colours of its theme, and as one Figure for a paper.

A figure is drawn once, in the colours of paper; on the page each of them is a variable of the theme (`TOKENS`). Colours
and markers of contestants are in report/style.py.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import matplotlib
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle

from quadexp.messages import html
from quadexp.report import style
from quadexp.report.document import THEME
from quadexp.report.style import HUES, MARKERS, MOST_VARIANTS, Figure, Look, shaded
from quadexp.report.table import Table

TOKENS = THEME | {  # CSS variable -> (light, dark)
    f"series-{hue}-{shade}": (shaded(hue, shade), shaded(hue, shade, dark=True))
    for hue in HUES
    for shade in range(MOST_VARIANTS)
}
INK, MUTED, RULE, ACCENT, ALARM = (TOKENS[name][0] for name in ("ink", "muted", "rule", "accent", "alarm"))
VARIABLES = {light: f"var(--{name})" for name, (light, _) in TOKENS.items()} | {"#dddddd": "var(--rule)"}
THEMED: Any = {  # colours of all that is no line of a contestant
    "text.color": INK, "axes.labelcolor": MUTED, "xtick.color": MUTED, "ytick.color": MUTED, "axes.edgecolor": RULE,
    "axes.titlecolor": INK, "legend.labelcolor": INK, "figure.facecolor": "none", "axes.facecolor": "none",
}  # fmt: skip
STYLE: Any = {
    **style.STYLE, **THEMED, "font.size": 8.5, "axes.titlesize": 9.5, "axes.titleweight": "normal",
    "axes.titlelocation": "left", "axes.titlepad": 8, "axes.spines.left": False, "ytick.major.size": 0,
    "xtick.minor.size": 0, "ytick.minor.size": 0, "grid.color": RULE,
}  # fmt: skip
SMALL, WIDE = (3.9, 3.0), (6.2, 4.1)  # inches, of a panel
LARGEST_DRAWING = 150_000  # characters of one figure as a drawing
DOTS = 100  # of a picture, an inch
_DROPPED = re.compile(r"<\?xml.*?\?>|<!DOCTYPE.*?>|<metadata>.*?</metadata>|<!--.*?-->", re.DOTALL)
_ID = re.compile(r'(\bid="|xlink:href="#|url\(#)')
_SIZE = re.compile(r'(<svg\b[^>]*?)\s(?:width|height)="[^"]*"')
_PATH = re.compile(r'\bd="[^"]*"')
_DECIMALS = re.compile(r"(\d+\.\d{2})\d+")
_COLOUR = re.compile("#[0-9a-f]{6}")


def marker_path(marker: str) -> str:
    """The path (SVG) of a marker of matplotlib, 9 units across, around zero."""
    shape: Any = MarkerStyle(marker)
    path = shape.get_path().transformed(shape.get_transform().scale(9, -9))
    letters = {path.MOVETO: "M", path.LINETO: "L", path.CURVE3: "Q", path.CURVE4: "C", path.CLOSEPOLY: "Z"}
    parts = path.iter_segments(simplify=False)
    return "".join(
        letters[code] + ("" if code == path.CLOSEPOLY else " ".join(f"{v:.2f}" for v in points))
        for points, code in parts
    )


SHAPES = {marker: marker_path(marker) for marker in MARKERS}


def inline_svg(figure: Figure, name: str, label: str, *, themed: bool = True) -> str:
    """The figure as an <svg> element. name: unique on the page. label: its description for screen readers. themed:
    colours are those of the page's theme."""
    stream = io.StringIO()
    with matplotlib.rc_context({**STYLE, "svg.fonttype": "none"}):
        figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    text = _DROPPED.sub("", stream.getvalue()).strip()
    if themed:
        text = _COLOUR.sub(lambda match: VARIABLES.get(match[0], match[0]), text)
    text = _ID.sub(lambda match: f"{match[1]}{name}-", text)
    for _ in range(2):
        text = _SIZE.sub(r"\1", text, count=1)
    text = _PATH.sub(lambda match: _DECIMALS.sub(r"\1", match[0]), text)
    text = re.sub(r"\s*\n\s*", "\n", text)
    return text.replace("<svg ", f'<svg role="img" aria-label="{html(label)}" ', 1)


def figure_html(make: Callable[[], Figure], name: str, label: str, *, themed: bool = True, rc: Any = THEMED) -> str:
    """A figure as HTML: in the colours of the theme, or on white. One of too many marks becomes a picture (PNG)."""
    with matplotlib.rc_context(rc if themed else {}):
        figure = make()
        drawing = inline_svg(figure, name, label, themed=themed)
    if pixels := len(drawing) > LARGEST_DRAWING:
        stream = io.BytesIO()
        make().savefig(stream, format="png", dpi=DOTS)
        data = base64.b64encode(stream.getvalue()).decode()
        drawing = f'<img alt="{html(label)}" src="data:image/png;base64,{data}">'
    plate = "" if themed and not pixels else ' class="plate"'
    return f'<figure{plate} style="--wide:{figure.get_size_inches()[0]:.1f}">{drawing}</figure>'


@dataclass(frozen=True)
class Sheet:
    """name: of its file for a paper. draws: what a panel shows -> the function that draws it. labels: of contestants in
    the key. text: below the panels. lines: label -> what is said of it. scores: a table below. whole: makes a figure
    that there is already, instead of panels."""

    name: str
    title: str
    draws: Mapping[str, Callable[[Any], None]]
    labels: Sequence[str] = ()
    text: str = ""
    size: tuple[float, float] = SMALL
    lines: Mapping[str, str] = field(default_factory=dict)
    scores: Table | None = None
    whole: Callable[[], Figure] | None = None

    def panels(self, anchor: str) -> list[str]:
        """As figures of the page. anchor: unique on the page."""
        if self.whole is not None:
            return [figure_html(self.whole, anchor, self.title, themed=False)]

        def panel(draw: Callable[[Any], None]) -> Figure:
            figure = Figure(figsize=self.size, layout="constrained")
            draw(figure.subplots())
            return figure

        panels = enumerate(self.draws.items())
        return [figure_html(partial(panel, draw), f"{anchor}-{k}", what, rc=STYLE) for k, (what, draw) in panels]

    def figure(self, look: Mapping[str, Look]) -> Figure:
        """For a paper: panels in rows of up to three, a legend below."""
        if self.whole is not None:
            return self.whole()
        columns = min(3, len(self.draws))
        lines = -(-len(self.draws) // columns)
        handles = [Line2D([], [], label=label, **look[label].points()) for label in self.labels]
        with matplotlib.rc_context(STYLE):
            height = 0.9 * self.size[1] * lines + 0.35 * -(-len(handles) // 4)
            figure = Figure(figsize=(0.85 * self.size[0] * columns, height), layout="constrained")
            panels = figure.subplots(lines, columns, squeeze=False).flat
            for panel, draw in zip(panels, self.draws.values(), strict=False):
                draw(panel)
            for panel in list(panels)[len(self.draws) :]:
                panel.set_axis_off()
            if handles:
                figure.legend(handles=handles, loc="outside lower center", ncols=min(4, len(handles)))
        return figure


def sheet_name(prefix: str, name: str) -> str:
    """A file name without blanks or separators."""
    return f"{prefix}_" + "".join(c if c.isalnum() else "_" for c in name.strip("/")).strip("_")
