"""What a publication or an experiment draws of a sweep: the module that `evaluate.figures=NAME` names, of a plug-in.

draw(rows, out) -> tables, figures  name -> Markdown, name -> figure, beside the standard ones; out: where flights lie
overview(rows) -> Table             printed too; only where the table of all controllers has no room
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.plugin import brought, places, service
from quadexp.writer import write_text

STANDARD = "standard"  # no figures but the standard ones

Drawn = tuple[dict[str, str], dict[str, Any]]  # tables and figures, see the module


def check(name: str) -> None:
    """Raise UsageError where there is no module of this name; nothing is imported."""
    known = [STANDARD, *places("papers")]
    if name not in known:
        raise UsageError(f"evaluate.figures={name}: there are {', '.join(known)}")


def paper(name: str) -> Any:
    """The module of a name that `check` lets pass; None for the standard figures."""
    return None if name == STANDARD else brought("papers", name)


def write(module: Any, rows: Sequence[Mapping[str, Any]], out: Path) -> dict[str, str]:
    """Write what a module draws into the folder of the results; returns name -> path."""
    drawing = service("drawing", "evaluate.figures")
    tables, figures = module.draw(rows, out)
    files = {}
    for name, text in tables.items():
        files[f"table_{name}"] = str(write_text(out / f"{name}.md", text))
    for name, figure in figures.items():
        files[f"figure_{name}"] = str(drawing.save(figure, out / "figures" / name))
    return files
