"""The page's figures: what was swept."""

from __future__ import annotations

from quadexp.errors import UsageError
from quadexp.plugins.drawing.style import figure_html
from quadexp.plugins.page.document import Block, Section
from quadexp.plugins.page.draw import figure_of
from quadexp.plugins.page.places import SUCCESS
from quadexp.plugins.page.report.source import Comparison
from quadexp.plugins.page.view import View, automatic
from quadexp.report.frame import SweepFrame
from quadexp.report.metrics import tabled

BUDGET = 650_000  # characters of all figures over what was swept
SWEPT = (
    "The axes are the keys that take several values. Means are over the flights that all compared settings completed;"
    " k/n: only k of n flights were completed; a cross: none was, or the settings contradict each other. `quadexp plot`"
    " draws other axes."
)


def swept_section(comparison: Comparison) -> tuple[Section, list[str], list[View]]:
    """The figures that `quadexp plot` draws without keys, a tab a quantity, as many as there is room for; what is left
    out; and the views of the main quantity."""
    frame = SweepFrame.read(comparison.root)
    room = BUDGET
    blocks = list[Block]()
    left_out = list[str]()
    main = list[View]()
    for metric in dict.fromkeys((comparison.metric, *tabled(), SUCCESS)):
        try:
            views = automatic(frame, metric, comparison.confidence)
        except UsageError:  # no flight has it
            continue
        main = main or views
        figures: list[str] = []
        for view in views:
            name = view.file_name.replace("_", " ")
            drawn = figure_html(figure_of(view), f"{view.y_label}, {name}. {view.caption}")
            room -= len(drawn)
            if room > 0:
                figures.append(drawn)
            else:
                left_out.append(f"{view.y_label} {name}, which `quadexp plot` draws")
        if figures:
            blocks.append(Block(views[0].y_label, metric, figures=figures))
    return Section("swept", "Swept", "What was swept", SWEPT, blocks), left_out, main
