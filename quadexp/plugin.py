"""What plug-ins bring: commands, kinds of models, figures, readers of logs, sections of the report page, papers.

Each is a seam: names, and where each is found, as text. The core of this program states its own in BRINGS below. Each
folder of quadexp/plugins, which may be deleted, states its own in a mapping of the same form in its __init__.py; so
does an installed package, in a module that an entry point names:

    [project.entry-points."quadexp.plugins"]
    my_lab = "my_lab"

    # in the module my_lab
    BRINGS = {"commands": {"laps": "my_lab:laps"}, "sections": {"laps": "my_lab:lap_section"}}

What a place must be:

    commands   a command (quadexp/cli/command.py)
    parts      a module, or a package, with parts of flights that options name
    models     a module with the records of a kind of models (quadexp/models/base.py)
    api        a name of the Python API (quadexp/__init__.py)
    tables     the Frame of a kind of files (quadexp/frames.py)
    columns    kind of files -> name -> Column (quadexp/log/schema.py), of what a plug-in logs
    services   a function that the core asks for, where it is there (see who asks)
    papers     a module with what quadexp/report/paper.py asks for
    readers    a module, or another object, with what quadexp/plugins/logs/importers/readers asks for
    sections   a function of a Page (quadexp/plugins/page/report)
    alternatives  "COMMAND --OPTION": a function that answers instead of a command that ships where that option is
               given. Its parameters are annotated as a command's; one of them is the option, and those that the command
               has not are options of it too. Those of installed packages do not count
    exports    a function as `quadexp export` calls it for models and vehicles (quadexp/plugins/exchange)

Of these a name stands for words, and no place:

    groups     a group of the configuration, which is there with its plug-in only (quadexp/parts/schema.py); read before
               anything else is imported, so those of installed packages do not count
    reads      what a command reads of the configuration (quadexp/parts/reads.py)
    spellings  a word for a kind of models, for one release more, of `fit-WORD` and WORD.KEY -> that kind
    modules    the name that a module had, for one release more -> its name
    kinds      a kind of tables -> the command that makes it, and what it is called
    templates  what `quadexp new` begins -> example, option and class of it (quadexp/cli/extend.py)
    advice     what is asked for -> what a message adds where it is not there; {} is where it was looked for

A name of this program is looked for first, so that what ships needs no look at what is installed. That look reads the
files entry_points.txt of sys.path itself: importlib.metadata, which does the same, takes as long to import as all the
rest of `quadexp --help`.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from quadexp.errors import ModuleError, UsageError

ENTRY_POINTS = "quadexp.plugins"  # group of the entry points, and the package of the plug-ins that ship
FOLDER = Path(__file__).parent / "plugins"
BRINGS: dict[str, dict[str, str]] = {
    "commands": {
        "simulate": "quadexp.cli.fly:simulate",
        "evaluate": "quadexp.cli.fly:evaluate",
        "collect": "quadexp.cli.learn:collect",
        "fit": "quadexp.cli.learn:fit",
        "fit-drag": "quadexp.cli.learn:fit_drag",
        "show": "quadexp.cli.look:show",
        "results": "quadexp.cli.look:results",
        "options": "quadexp.cli.extend:options",
        "new": "quadexp.cli.extend:new",
        "cache": "quadexp.cli.extend:cache",
    },
    "parts": {},
    "models": {"coefficients": "quadexp.models.coefficients", "linear_drag": "quadexp.models.linear_drag"},
    "alternatives": {},
    "api": {},
    "tables": {},
    "columns": {},
    "groups": {},
    "reads": {
        "simulate": "FLIGHT",
        "evaluate": "FLIGHT evaluate.metric evaluate.figures evaluate.log_period",
        "evaluate --sweep": "FLIGHT evaluate engine sweep",
        "collect": "LOOP collect",
        "collect --sweep": "LOOP collect sweep",
        "collect --flight": "vehicle collect.frame collect.thrust collect.state collect.target collect.identified",
        "fit": "vehicle fit",
        "qx.controller": "FLIGHT",
    },
    "services": {},
    "spellings": {"drag": "linear_drag"},
    "kinds": {
        "flight": "simulate a flight",
        "residuals": "collect a data set",
        "results": "evaluate a table of results",
        "statistics": "evaluate a table of statistics",
    },
    "papers": {},
}


@cache
def shipped_plugins() -> tuple[str, ...]:
    """Names of the plug-ins that ship and are there."""
    folders = os.listdir(FOLDER) if FOLDER.is_dir() else []
    return tuple(sorted(name for name in folders if (FOLDER / name / "__init__.py").is_file()))


@cache
def _shipped() -> dict[str, dict[str, str]]:
    """Seam -> name -> place of what this program brings: its core, then its plug-ins."""
    seams = {seam: dict(named) for seam, named in BRINGS.items()}
    for plugin in shipped_plugins():
        brings: Mapping[str, Mapping[str, str]] = importlib.import_module(f"{ENTRY_POINTS}.{plugin}").BRINGS
        for seam, named in brings.items():
            seams.setdefault(seam, {}).update(named)
    return seams


def shipped_places(seam: str) -> dict[str, str]:
    """Name -> place of what this program itself brings to a seam; nothing where no plug-in that is there opens it."""
    return _shipped().get(seam, {})


def places(seam: str) -> dict[str, str]:
    """Name -> place of everything that a seam has: first what ships, then what installed packages bring.

    Raises UsageError where two bring the same name, or one is not of the form above.
    """
    return shipped_places(seam) | {name: place for name, (place, _) in _outside().get(seam, {}).items()}


def brought(seam: str, name: str) -> Any:
    """What a name of a seam stands for; None where there is none.

    Raises ModuleError or UsageError where it cannot be imported."""
    place = BRINGS.get(seam, {}).get(name) or shipped_places(seam).get(name)
    if place is not None:
        return _found(place)
    if name not in _outside().get(seam, {}):
        return None
    place, point = _outside()[seam][name]
    said = f"entry point {point!r} of {ENTRY_POINTS}: {seam}: {name}: {place}"
    try:
        return _found(place)
    except ImportError as error:
        raise ModuleError(f"{said}: {error}") from None
    except AttributeError as error:
        raise UsageError(f"{said}: {error}") from None


def service(name: str, wanted: str) -> Any:
    """What a plug-in does for the core. wanted: what was asked for, for the message.

    Raises UsageError where no plug-in brings it."""
    brought_service = brought("services", name)
    if brought_service is None:
        raise UsageError(f"{wanted}: no installed plug-in has {name!r} (quadexp/plugins)")
    return brought_service


def advice(name: str, place: object) -> str:
    """What a plug-in can do for what is not there, as the end of a message; "" without it."""
    return shipped_places("advice").get(name, "").format(place)


def _found(place: str) -> Any:
    """What stands at MODULE or MODULE:ATTRIBUTE."""
    module, _, attribute = place.partition(":")
    attribute_value = importlib.import_module(module)
    return getattr(attribute_value, attribute) if attribute else attribute_value


@cache
def _outside() -> dict[str, dict[str, tuple[str, str]]]:
    """Seam -> name -> place and entry point, of what installed packages bring."""
    shipped = _shipped()
    seams: dict[str, dict[str, tuple[str, str]]] = {seam: {} for seam in shipped}
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
                if name in shipped[seam] or name in seams[seam]:
                    raise UsageError(f"{said}: BRINGS[{seam!r}]: {name!r} is taken: choose another name")
                if not isinstance(place, str):
                    raise UsageError(f"{said}: BRINGS[{seam!r}][{name!r}]: must be a text MODULE:ATTRIBUTE")
                seams[seam][name] = place, point
    return seams


@cache
def entry_points(group: str) -> dict[str, str]:
    """Name -> value of the entry points of a group, of all packages on sys.path; the first of a name counts."""
    points: dict[str, str] = {}
    for folder in map(Path, sys.path):
        names = os.listdir(folder) if folder.is_dir() else []
        for name in sorted(name for name in names if name.endswith((".dist-info", ".egg-info"))):
            file = folder / name / "entry_points.txt"
            text = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""
            if f"[{group}]" in text:
                points = _points(text, group) | points
    return points


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
