"""What a publication or an experiment draws of a sweep: the module that `evaluate.figures=NAME` names, of a plug-in.

draw(rows, out) -> tables, figures  name -> Markdown, name -> figure, beside the standard ones; out: where flights lie
overview(rows) -> Table             printed too; only where the table of all controllers has no room
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.plugin import brought, places
from quadexp.writer import write_text

STANDARD = "standard"  # no figures but the standard ones

Drawn = tuple[dict[str, str], dict[str, Any]]  # tables and figures, see the module


def check(name: str) -> None:
    """Raise UsageError where there is no module of this name; nothing is imported."""
    if name != STANDARD and name not in places("papers"):
        raise UsageError(f"evaluate.figures={name}: there are {', '.join([STANDARD, *places('papers')])}")


def paper(name: str) -> Any:
    """The module of a name that `check` lets pass; None for the standard figures."""
    return None if name == STANDARD else brought("papers", name)


def write(module: Any, rows: Sequence[Mapping[str, Any]], out: Path) -> dict[str, str]:
    """Write what a module draws into the folder of the results; returns name -> path."""
    from quadexp.report.style import save

    tables, figures = module.draw(rows, out)
    files = {f"table_{name}": write_text(out / f"{name}.md", text) for name, text in tables.items()}
    files |= {f"figure_{name}": save(figure, out / "figures" / name, out) for name, figure in figures.items()}
    return {name: str(path) for name, path in files.items()}
