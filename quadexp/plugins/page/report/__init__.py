"""The report of a comparison: one HTML file that opens without a network, and its figures as PDF."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from quadexp import __version__
from quadexp.errors import UsageError
from quadexp.names import file_name
from quadexp.plugin import brought, places
from quadexp.plugins.drawing.style import save_figure
from quadexp.plugins.page.document import Section, document
from quadexp.plugins.page.draw import figure_of
from quadexp.plugins.page.report.answer import answer
from quadexp.plugins.page.report.panels import swept_section
from quadexp.plugins.page.report.sections import Page, numbers, scoreboard
from quadexp.plugins.page.report.source import Comparison, read_comparison
from quadexp.writer import check_output, write_text

MOST_LINES = 200  # of a table
COLUMN = 3.5  # inches, of the IEEE


def make_report(
    results: str | Path,
    out: str | Path,
    *,
    figures: str | Path | None = None,
    baseline: str | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Write the report of a results folder as one HTML file; returns its answer and the paths of the files.

    figures: folder for the same figures as PDF, a file a panel, as wide as a column. baseline: a controller.
    Raises UsageError or DataError, before anything is written.
    """
    out = check_output(out, force=force)
    if figures is not None:
        check_output(figures, force=True, folder=True)
    comparison = read_comparison(results, baseline=baseline)
    swept, left_out, views = swept_section(comparison)
    words = ["quadexp", "report", comparison.place(comparison.root), "--out", comparison.place(out), "--force"]
    if baseline:
        words += ["--baseline", baseline]
    if figures:
        words += ["--figures", comparison.place(Path(figures))]
    page, left_out = render(comparison, swept, shlex.join(words), left_out)
    write_text(out, page, force=force)
    saved = {}
    if figures:
        for name, part in chain.from_iterable(view.parts().items() for view in views):
            path = Path(figures) / f"{file_name(name)}.pdf"
            saved[name] = save_figure(figure_of(replace(part, width=COLUMN)), path)
    answered = answer(comparison)
    checked = comparison.checked
    return {
        "path": out,
        "bytes": len(page.encode()),
        "answer": list(answered.sentences),
        "note": answered.note,
        "checked": checked._asdict() | {"text": checked.text(), "lines": checked.lines()},
        "left_out": left_out,
        "figures": saved,
    }


def render(comparison: Comparison, swept: Section, command: str, left_out: Sequence[str]) -> tuple[str, list[str]]:
    """The page, and what is not on it for its size. command: that makes it again. left_out: of what was swept."""
    whole = numbers(comparison)
    short = []
    for block in whole.blocks:
        tables = {name: replace(t, rows=t.rows[:MOST_LINES]) for name, t in block.tables.items()}
        short.append(replace(block, tables=tables))
    left_out = [*_left_out(comparison, whole), *left_out]
    parts = Page(comparison, replace(whole, blocks=short), swept, command, tuple(left_out))
    sections = []
    for name, place in places("sections").items():
        section = brought("sections", name)(parts)
        if not isinstance(section, Section):
            raise UsageError(f"section {name}: {place} returns a {type(section).__name__}, not a Section")
        if section.blocks:
            sections.append(section)
    page = document(
        f"{comparison.root.resolve().name} – quadexp report",
        sections,
        answer=answer(comparison),
        board=scoreboard(comparison),
        looks=comparison.look,
        row_notes=[*comparison.checked.lines(), *comparison.notes],
        left_out=left_out,
        version=__version__,
    )
    return page, left_out


def _left_out(comparison: Comparison, whole: Section) -> list[str]:
    """What is not on the page for its size, one entry each."""
    entries = []
    lines = max((len(next(iter(b.tables.values())).rows) for b in whole.blocks), default=0)
    looked = len(comparison.sampled())
    if lines > MOST_LINES:
        entries.append(f"{lines - MOST_LINES} of {lines} lines of the tables")
    if looked < len(comparison.rows):
        entries.append(f"settings of flights beyond {looked} of {len(comparison.rows)}, evenly chosen")
    return entries
