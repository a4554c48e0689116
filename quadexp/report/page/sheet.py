"""A sheet of the report: panels that belong together, as inline SVG for the page and as one Figure for a paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import matplotlib
from matplotlib.lines import Line2D

from quadexp.report.page.palette import PAGE, PAPER, STYLE, inline_svg
from quadexp.report.page.source import spoken
from quadexp.report.style import Figure, Look

SMALL, WIDE = (3.9, 3.0), (6.2, 4.1)  # inches, of a panel

Draw = Callable[..., None]  # (panel, palette=Palette)


@dataclass(frozen=True)
class Sheet:
    """name: of its file for a paper. draws: what a panel shows -> the function that draws it. labels: of those in the
    key. text: below the panels. more: what else the template says of them."""

    name: str
    title: str
    draws: Mapping[str, Draw]
    labels: Sequence[str] = ()
    text: str = ""
    size: tuple[float, float] = SMALL
    more: Mapping[str, Any] = field(default_factory=dict)

    def record(self, anchor: str) -> dict[str, Any]:
        """For the template. anchor: unique on the page."""
        panels = [self._svg(draw, f"{anchor}-{k}", what) for k, (what, draw) in enumerate(self.draws.items())]
        return {"title": self.title, "labels": self.labels, "text": self.text, "panels": panels, **self.more}

    def _svg(self, draw: Draw, name: str, label: str) -> str:
        with matplotlib.rc_context(STYLE):
            figure = Figure(figsize=self.size, layout="constrained")
            draw(figure.subplots(), palette=PAGE)
            return inline_svg(figure, name, label)

    def figure(self, look: Mapping[str, Look]) -> Figure:
        """For a paper: panels in rows of up to three, a legend below."""
        columns = min(3, len(self.draws))
        lines = -(-len(self.draws) // columns)
        handles = [Line2D([], [], linestyle=look[x].dash, label=spoken(x), **PAPER.mark(look[x])) for x in self.labels]
        with matplotlib.rc_context(STYLE):
            height = 0.9 * self.size[1] * lines + 0.35 * -(-len(handles) // 4)
            figure = Figure(figsize=(0.85 * self.size[0] * columns, height), layout="constrained")
            panels = figure.subplots(lines, columns, squeeze=False)
            for panel, draw in zip(panels.flat, self.draws.values(), strict=False):
                draw(panel, palette=PAPER)
            for panel in panels.flat[len(self.draws) :]:
                panel.set_axis_off()
            if handles:
                figure.legend(handles=handles, loc="outside lower center", ncols=min(4, len(handles)))
        return figure


def sheet_name(prefix: str, name: str) -> str:
    """A file name without blanks or separators."""
    return f"{prefix}_" + "".join(c if c.isalnum() else "_" for c in name.strip("/")).strip("_")
