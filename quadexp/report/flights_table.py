"""Flights of a sweep as a table: any columns and keys, for the terminal, as CSV, and as a sortable page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from quadexp.report.document import sortable_page
from quadexp.report.frame import SweepFrame, is_metric, is_number, with_unit
from quadexp.report.table import Table, csv_text
from quadexp.report.view import unit_and_factor


class FlightsTable(NamedTuple):
    """names: of the columns that are shown."""

    names: list[str]
    table: Table


def flights_table(frame: SweepFrame, names: Sequence[str], *, all_of_them: bool = True) -> FlightsTable:
    """The flights with these columns, in the units in which tables show them. all_of_them: also empty columns.

    Raises UsageError for a name that is no column and no key.
    """
    columns = {name: frame.column(name) for name in names}
    used = [name for name in names if all_of_them or any(value is not None for value in columns[name])]
    rows = [[_text(name, columns[name][i]) for name in used] for i in range(len(frame.rows))]
    left = frozenset(i for i, name in enumerate(used) if not all(is_number(v) for v in columns[name] if v is not None))
    return FlightsTable(used, Table([heading(name) for name in used], rows, left=left))


def csv_of(frame: SweepFrame, names: Sequence[str]) -> str:
    """The flights as CSV: SI units, every digit."""
    return csv_text(names, zip(*(frame.column(name) for name in names), strict=True))


def page_of(frame: SweepFrame, names: Sequence[str], title: str) -> str:
    """The flights as a page that sorts and filters, and opens without a network."""
    return sortable_page(title, flights_table(frame, names).table, notes=[f"{len(frame.rows)} flights of {title}"])


def heading(name: str) -> str:
    """The name with the unit in which its numbers are shown."""
    unit = unit_and_factor(name)[1]
    return with_unit(name, name) if not is_metric(name) else f"{name} ({unit})" if unit else name


def _text(name: str, value: Any) -> str:
    if value is None:
        return ""
    if not is_number(value):
        return str(value).lower() if isinstance(value, bool) else str(value)
    if is_metric(name):
        return f"{unit_and_factor(name)[0] * value:.4g}"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
