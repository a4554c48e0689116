"""What can be brought from outside: commands, readers of logs, sections of the report page, papers.

Each is a seam: names, and where each is found, as text. This program states its own in BRINGS below; an installed
package states its own in a mapping of the same form, in a module that an entry point names:

    [project.entry-points."quadexp.plugins"]
    my_lab = "my_lab"

    # in the module my_lab
    BRINGS = {"commands": {"laps": "my_lab:laps"}, "sections": {"laps": "my_lab:lap_section"}}

What a place must be: of "commands" a command (quadexp/cli/command.py), of "readers" a module, or another object, with
what quadexp/log/importers/readers asks for, of "sections" a function of a Page (quadexp/report/page), of "papers" a
module with what quadexp/papers asks for. A name of this program is looked for first, so that what ships needs no look
at what is installed. That look reads the files entry_points.txt of sys.path itself: importlib.metadata, which does the
same, takes as long to import as all the rest of `quadexp --help`.
"""

from __future__ import annotations

import importlib
import os
import sys
from functools import cache
from pathlib import Path
from typing import Any

from quadexp.errors import ModuleError, UsageError

ENTRY_POINTS = "quadexp.plugins"  # group of the entry points
BRINGS: dict[str, dict[str, str]] = {
    "commands": {
        "simulate": "quadexp.cli.fly:simulate",
        "evaluate": "quadexp.cli.fly:evaluate",
        "tune": "quadexp.cli.fly:tune",
        "bench": "quadexp.cli.fly:bench",
        "import": "quadexp.cli.logs:import_",
        "check": "quadexp.cli.logs:check",
        "collect": "quadexp.cli.learn:collect",
        "fit": "quadexp.cli.learn:fit",
        "fit-gp": "quadexp.cli.learn:fit_gp",
        "fit-drag": "quadexp.cli.learn:fit_drag",
        "fit-nn": "quadexp.cli.learn:fit_nn",
        "identify": "quadexp.cli.learn:identify",
        "validate": "quadexp.cli.learn:validate",
        "show": "quadexp.cli.look:show",
        "compare": "quadexp.cli.look:compare",
        "results": "quadexp.cli.look:results",
        "table": "quadexp.cli.paper:table",
        "plot": "quadexp.cli.look:plot",
        "report": "quadexp.cli.look:report",
        "animate": "quadexp.cli.look:animate",
        "export": "quadexp.cli.look:export",
        "archive": "quadexp.plugins.paper.command:archive",
        "options": "quadexp.cli.extend:options",
        "new": "quadexp.cli.extend:new",
        "cache": "quadexp.cli.extend:cache",
    },
    "readers": {  # the most general last: to it any text is a table
        "rosbag": "quadexp.log.importers.readers.rosbag",
        "ulog": "quadexp.log.importers.readers.ulog",
        "csv": "quadexp.log.importers.readers.csv",
    },
    "sections": {
        "numbers": "quadexp.report.page.sections:numbers_section",
        "swept": "quadexp.report.page.sections:swept_section",
        "worst": "quadexp.report.page.sections:worst_section",
        "origin": "quadexp.report.page.sections:origin_section",
    },
    "papers": {
        "adaptation": "quadexp.papers.adaptation",
        "families": "quadexp.papers.families",
        "ladder": "quadexp.papers.ladder",
        "lei_li": "quadexp.papers.lei_li",
        "sun": "quadexp.papers.sun",
    },
}


def places(seam: str) -> dict[str, str]:
    """Name -> place of everything that a seam has: first what ships, then what installed packages bring.

    Raises UsageError where two bring the same name, or one is not of the form above.
    """
    return BRINGS[seam] | {name: place for name, (place, _) in _outside()[seam].items()}


def brought(seam: str, name: str) -> Any:
    """What a name of a seam stands for; None where there is none.

    Raises ModuleError or UsageError where it cannot be imported."""
    place = BRINGS[seam].get(name)
    if place is not None:
        return _found(place)
    if name not in _outside()[seam]:
        return None
    place, point = _outside()[seam][name]
    said = f"entry point {point!r} of {ENTRY_POINTS}: {seam}: {name}: {place}"
    try:
        return _found(place)
    except ImportError as error:
        raise ModuleError(f"{said}: {error}") from None
    except AttributeError as error:
        raise UsageError(f"{said}: {error}") from None


def _found(place: str) -> Any:
    """What stands at MODULE or MODULE:ATTRIBUTE."""
    module, _, attribute = place.partition(":")
    found = importlib.import_module(module)
    return getattr(found, attribute) if attribute else found


@cache
def _outside() -> dict[str, dict[str, tuple[str, str]]]:
    """Seam -> name -> place and entry point, of what installed packages bring."""
    seams: dict[str, dict[str, tuple[str, str]]] = {seam: {} for seam in BRINGS}
    for point, module in sorted(entry_points(ENTRY_POINTS).items()):
        said = f"entry point {point!r} of {ENTRY_POINTS}"
        try:
            brings = getattr(importlib.import_module(module), "BRINGS", None)
        except Exception as error:
            text = " ".join(str(error).split())
            raise ModuleError(f"{said}: importing {module} raised {type(error).__name__}: {text}") from error
        if not isinstance(brings, dict) or not brings:
            raise UsageError(f"{said}: module {module} has no BRINGS = {{SEAM: {{NAME: 'MODULE:ATTRIBUTE'}}}}")
        for seam, named in brings.items():
            if seam not in seams:
                raise UsageError(f"{said}: BRINGS[{seam!r}]: no such seam; there are {', '.join(seams)}")
            for name, place in dict(named).items():
                if name in BRINGS[seam] or name in seams[seam]:
                    raise UsageError(f"{said}: BRINGS[{seam!r}]: {name!r} is taken: choose another name")
                if not isinstance(place, str):
                    raise UsageError(f"{said}: BRINGS[{seam!r}][{name!r}]: must be a text MODULE:ATTRIBUTE")
                seams[seam][name] = place, point
    return seams


@cache
def entry_points(group: str) -> dict[str, str]:
    """Name -> value of the entry points of a group, of all packages on sys.path; the first of a name counts."""
    found: dict[str, str] = {}
    for folder in map(Path, sys.path):
        names = os.listdir(folder) if folder.is_dir() else []
        for name in sorted(name for name in names if name.endswith((".dist-info", ".egg-info"))):
            file = folder / name / "entry_points.txt"
            text = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""
            if f"[{group}]" in text:
                found = _points(text, group) | found
    return found


def _points(text: str, group: str) -> dict[str, str]:
    """Those of one file, whose sections are [GROUP] and whose lines are NAME = VALUE."""
    points: dict[str, str] = {}
    section = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("["):
            section = line.strip("[]").strip()
        elif section == group and "=" in line and not line.startswith(("#", ";")):
            name, _, value = line.partition("=")
            points[name.strip()] = value.partition("[")[0].strip()
    return points
