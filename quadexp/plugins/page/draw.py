"""The one drawer: a view as lines (line_figure.py) or as a heat map (heat_map.py), with the mean of a metric over any
keys.

A file is PNG, PDF or SVG, or one HTML page with the numbers, which opens offline. With `View.width` it is for a paper:
as wide as a column or page of the IEEE with letters that fit it, and its notes are left to the caption.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib

from quadexp.errors import UsageError
from quadexp.log.store import read_flight
from quadexp.names import named
from quadexp.plugins.drawing.style import PICTURES, STYLE, Figure, figure_html, save_figure
from quadexp.plugins.page.differences import names_of
from quadexp.plugins.page.document import sortable_page
from quadexp.plugins.page.heat_map import heat_map
from quadexp.plugins.page.line_figure import line_figure
from quadexp.plugins.page.view import View, view
from quadexp.report.frame import SweepFrame, read_results
from quadexp.report.pairing import SOURCE
from quadexp.report.table import records_table
from quadexp.writer import write_text

SUFFIXES = (*PICTURES, "html")
ON_PAPER: Any = {  # letters of the size and kind of the text around: Times, in its free form
    "font.size": 8,
    "axes.titlesize": 8,
    "legend.fontsize": 7,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "lines.linewidth": 1.2,
    "font.family": ["STIXGeneral", "DejaVu Sans"],
    "mathtext.fontset": "stix",
}


def plot_results(
    frame: SweepFrame, *, by: str | Sequence[str] | None, facet: str | Sequence[str] | None, **options: Any
) -> Figure:
    """Results of the Python API; see `view`."""
    lines = [by] if isinstance(by, str) else by
    panels = [facet] if isinstance(facet, str) else facet
    return figure_of(view(frame, by=lines, facet=panels, **options))


def figure_of(view: View) -> Figure:
    """The matplotlib figure of a view, on paper with smaller letters."""
    with matplotlib.rc_context({**STYLE, **(ON_PAPER if view.width else {})}):
        return heat_map(view) if view.kind == "heat" else line_figure(view)


def records(view: View) -> list[dict[str, Any]]:
    """The numbers behind a view, a record a place: its keys, and mean, low, high in SI units."""
    rows = []
    for place, point in view.places.items():
        keys = named(view.keys, place)
        about = {"seeds": point.seeds, "flights": point.flights, "ended": point.ended, "trials": point.trials}
        numbers = {view.y: point.mean, "low": point.low, "high": point.high, "interval": point.method}
        rows.append({**keys, **numbers, **about, "invalid": point.invalid})
    return rows


def save_view(view: View, path: Path, title: str = "", *, force: bool = True) -> Path:
    """Write the figure of a view in the format that the path's suffix names."""
    if path.suffix.lower() == ".html":
        return write_text(path, page_of(view, title), force=force)
    return save_figure(figure_of(view), path, force=force)


def page_of(view: View, title: str) -> str:
    """The figure with its numbers as one page that opens without a network."""
    rows = records(view)
    for row in rows:
        for name, value in row.items():
            if name in (view.y, "low", "high"):
                value = view.factor * value
            if isinstance(value, float):
                row[name] = float(f"{value:.6g}")
    table = records_table(rows)
    heads = [f"{name} ({view.unit})" if name == view.y and view.unit else name for name in table.columns]
    heading = view.heading or title or view.y_label
    notes = (view.caption, *view.notes)
    figure = figure_html(figure_of(view), heading)
    return sortable_page(heading, replace(table, columns=heads), figures=[figure], notes=notes)


def comparison_figure(kind: str, paths: Sequence[Path]) -> Figure:
    """Paths and errors of several flights, or errors of several results; UsageError where there is nothing to draw."""
    if kind == "flight":
        from quadexp.plugins.page.flight_figures import flights_figure

        return flights_figure(named(names_of(paths), map(read_flight, paths)))
    if kind == "results":
        return results_figure(paths)
    raise UsageError("--out: draws flights and results; the scores of checkpoints are in the table")


def results_figure(paths: Sequence[Path]) -> Figure:
    """Errors of every results folder, a line each: over the key with most values, a panel a controller and path."""
    rows: list[dict[str, Any]] = []
    record: dict[str, Any] = {}
    for path, name in zip(paths, names_of(paths), strict=True):
        _, flights, about = read_results(path)
        record = record or {key: about[key] for key in ("metric", "confidence") if key in about}
        for row in flights:
            variant = f"{row.get('variant') or ''} {SOURCE}={name}".strip()
            rows.append({**row, "variant": variant})
    frame = SweepFrame(rows, paths[0], record)
    aside = (SOURCE, "controller", "model", "trajectory", "seed")
    axes = [key for key in frame.swept if key not in aside]
    x = max(axes, key=lambda key: len(frame.values(key)), default="controller")
    return figure_of(view(frame, x=x, by=[SOURCE], y=str(record.get("metric", "mean_error"))))
