"""The tables of a sweep in LaTeX, each one that fits a column or a page of the IEEE (fitted.py)."""

from __future__ import annotations

from dataclasses import replace

from quadexp.plugins.page.fitted import WIDTHS, fitted_latex, tabulars
from quadexp.plugins.page.paper_cells import Intervals, compact_cell
from quadexp.report.statistics import Statistics
from quadexp.report.table import Table
from quadexp.report.tables import error_table


def paper_texts(statistics: Statistics, metric: str, table: Table, comparison: Table | None) -> dict[str, str]:
    """Name -> content of `table.tex`, the error table of a metric with shorter cells than `table` has, and of
    `comparison.tex`, where there is a comparison."""
    texts = {"table.tex": _error_table(statistics, metric)}
    if comparison is not None:
        texts["comparison.tex"] = fitted_latex(replace(comparison, beside=3), WIDTHS["page"])
    return texts


def _error_table(statistics: Statistics, metric: str) -> str:
    """The error table as one tabular in a column, or a page, without intervals where it takes that; else as several."""
    choices: tuple[tuple[str, Intervals], ...] = (("column", "brackets"), ("page", "brackets"), ("page", "none"))
    for width, intervals in choices:
        table = error_table(
            statistics.flights,
            metric,
            baseline=statistics.baseline,
            confidence=statistics.confidence,
            cell=compact_cell(intervals),
        )
        table = replace(table, rows=table.rows[table.head :], head=0)  # cells say how many were completed
        if len(tabulars(table, WIDTHS[width])) == 1:
            break
    return fitted_latex(table, WIDTHS[width])
