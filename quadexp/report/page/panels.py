"""The page's figures: what was swept."""

from __future__ import annotations

from dataclasses import dataclass, field

from quadexp.errors import UsageError
from quadexp.report.document import Block, Section
from quadexp.report.draw import figure_of
from quadexp.report.frame import SweepFrame
from quadexp.report.page.source import TABLED, Comparison
from quadexp.report.style import Figure, figure_html
from quadexp.report.view import SUCCESS, View, automatic

BUDGET = 650_000  # characters of all figures over what was swept
SWEPT = (
    "The axes are the keys that take several values. Means are over the flights that all compared settings completed;"
    " k/n: only k of n flights were completed; a cross: none was, or the settings contradict each other. `quadexp plot`"
    " draws other axes."
)


@dataclass
class Swept:
    """The figures that `quadexp plot` draws without keys. tabs: name, title and figures (HTML) of each quantity. left:
    what is not on the page. views: of the main quantity."""

    tabs: list[tuple[str, str, list[str]]] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    views: list[View] = field(default_factory=list)

    @classmethod
    def of(cls, comparison: Comparison) -> Swept:
        """The figures that are chosen by what was swept, as many as there is room for."""
        swept, frame, room = cls(), SweepFrame.read(comparison.root), BUDGET
        for metric in dict.fromkeys((comparison.metric, *TABLED, SUCCESS)):
            try:
                views = automatic(frame, metric, comparison.confidence)
            except UsageError:  # no flight has it
                continue
            swept.views = swept.views or views
            figures: list[str] = []
            for view in views:
                name = view.file_name.replace("_", " ")
                drawn = figure_html(figure_of(view), f"{view.y_label}, {name}. {view.caption}")
                if (room := room - len(drawn)) > 0:
                    figures.append(drawn)
                else:
                    swept.left.append(f"{view.y_label} {name}, which `quadexp plot` draws")
            swept.tabs += [(metric, views[0].y_label, figures)] if figures else []
        return swept

    def figures(self) -> dict[str, Figure]:
        """Name -> figure of the main quantity."""
        return {f"{view.y.removesuffix('_error')}_error_{view.file_name}": figure_of(view) for view in self.views}


def swept_section(swept: Swept) -> Section:
    """A tab a quantity."""
    blocks = [Block(title, name, figures=figures) for name, title, figures in swept.tabs]
    return Section("swept", "Swept", "What was swept", SWEPT, blocks)
