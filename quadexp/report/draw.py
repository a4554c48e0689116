"""Draws one figure of a sweep; what may be called in another process, which imports matplotlib then."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def draw(kind: str, inputs: tuple[Any, ...], path: Path) -> bool:
    """Draw a figure (drawing.py) and write it as SVG and PNG, each whole or not at all.

    path: of the SVG. Returns False where there is nothing to show.
    """
    from quadexp.report import figures

    makers: dict[str, Any] = {
        "error": figures.error_against_speed,
        "times": figures.solve_times,
        "paths": figures.path_figure,
    }
    figure = makers[kind](*inputs)
    if figure is not None:
        figures.save(figure, path)
    return figure is not None
