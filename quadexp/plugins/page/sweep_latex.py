"""The tables of a sweep in LaTeX, each one that fits a column or a page of the IEEE (fitted.py)."""

from __future__ import annotations

from dataclasses import replace

from quadexp.plugins.page.fitted import WIDTHS, fitted_latex, tabulars
from quadexp.plugins.page.paper_cells import Intervals, compact_table
from quadexp.report.statistics import Statistics
from quadexp.report.table import Table

CHOICES: tuple[tuple[str, Intervals], ...] = (("column", "brackets"), ("page", "brackets"), ("page", "none"))


def paper_texts(statistics: Statistics, metric: str, table: Table, comparison: Table | None) -> dict[str, str]:
    """Name -> content of `table.tex`, the error table of a metric with shorter cells than `table` has, and of
    `comparison.tex`, where there is a comparison.

    The error table is the first of CHOICES that takes one tabular; else several of the last one."""
    for width, intervals in CHOICES:
        compact = compact_table(statistics.flights, metric, statistics.baseline, statistics.confidence, intervals)
        if len(tabulars(compact, WIDTHS[width])) == 1:
            break
    texts = {"table.tex": fitted_latex(compact, WIDTHS[width])}
    if comparison is not None:
        texts["comparison.tex"] = fitted_latex(replace(comparison, beside=3), WIDTHS["page"])
    return texts
