"""Draws one figure of a sweep; what may be called in another process, which imports matplotlib then."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quadexp.report.style import Figure


def draw(kind: str, inputs: tuple[Any, ...], path: Path) -> bool:
    """Draw a figure (drawing.py) and write it as SVG and PNG, each whole or not at all.

    path: of the SVG. Returns False where there is nothing to show.
    """
    from quadexp.report import figures

    makers: dict[str, Any] = {
        "times": figures.solve_times,
        "paths": figures.path_figure,
        "axes": _swept,
    }
    figure = makers[kind](*inputs)
    if figure is not None:
        figures.save(figure, path, inside=path.parent.parent)
    return figure is not None


def _swept(
    rows: Sequence[Mapping[str, Any]], out: str, metric: str, confidence: float, record: Mapping[str, Any], which: int
) -> Figure:
    """One of the figures that were chosen by what was swept."""
    from quadexp.report.axes.frame import SweepFrame
    from quadexp.report.axes.save import figure_of
    from quadexp.report.axes.view import automatic

    return figure_of(automatic(SweepFrame(rows, out, record), metric, confidence)[which])
