"""A view as a figure, and as a file: PNG, PDF, SVG, or one HTML page with its numbers, which opens offline."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.files.writer import check_output, write_text, written
from quadexp.report.axes.draw import figure_of
from quadexp.report.axes.view import View
from quadexp.report.sortable import Column, sortable_page
from quadexp.report.style import Figure, styled

SUFFIXES = ("png", "pdf", "svg", "html")


def records(view: View) -> list[dict[str, Any]]:
    """The numbers behind a view, a record a place: its keys, and mean, low, high in SI units."""
    made = []
    for place, point in view.places.items():
        keys = dict(zip(view.keys, place, strict=True))
        about = {"seeds": point.seeds, "flights": point.flights, "ended": point.ended, "trials": point.trials}
        numbers = {view.y: point.mean, "low": point.low, "high": point.high, "interval": point.method}
        made.append({**keys, **numbers, **about, "invalid": point.invalid})
    return made


def check_path(path: Path, force: bool, suffixes: Sequence[str] = SUFFIXES) -> Path:
    """The path of a figure; UsageError for a suffix of none of the formats, or a file that is there."""
    if path.suffix.lower().lstrip(".") not in suffixes:
        raise UsageError(f"--out {path}: a figure is a file .{', .'.join(suffixes)}")
    return check_output(path, force=force)


@styled
def save_view(view: View, path: Path, title: str = "", *, force: bool = True) -> Path:
    """Write the figure of a view in the format that the path's suffix names."""
    form = path.suffix.lower().lstrip(".")
    if form == "html":
        return write_text(path, page_of(view, title), force=force)
    return save_figure(figure_of(view), path, force=force)


@styled
def save_figure(figure: Figure, path: Path, *, force: bool = True) -> Path:
    """Write a figure as PNG, PDF or SVG, without the time at which it was drawn."""
    form = path.suffix.lower().lstrip(".")
    dated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    with written(path, force=force) as file:
        figure.savefig(file, format=form, dpi=150, metadata=dated.get(form))
    return path


@styled
def page_of(view: View, title: str) -> str:
    """The figure with its numbers as one page that opens without a network."""
    stream = io.StringIO()
    figure_of(view).savefig(stream, format="svg", metadata={"Date": None})
    svg = stream.getvalue()
    rows = records(view)
    columns = [Column(name, f"{name} ({view.unit})" if name == view.y and view.unit else name) for name in rows[0]]
    scaled = [{**row, **{n: view.factor * row[n] for n in (view.y, "low", "high")}} for row in rows]
    return sortable_page(
        title or view.y_label, columns, scaled, above=svg[svg.index("<svg") :], notes=(view.caption, *view.notes)
    )
