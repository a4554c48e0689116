"""Configuration that comes from outside: installed packages, and the folder given with --conf.

A package offers options of its own (vehicles, plants, trajectories, controllers, experiments) by an entry point of the
group `quadexp.conf` whose value is the package that holds the folders, laid out as conf/ is:

    [project.entry-points."quadexp.conf"]
    my_lab = "my_lab.conf"
"""

from __future__ import annotations

import functools
import importlib.util
import os
import sys
from importlib.metadata import entry_points
from pathlib import Path

from quadexp.errors import UsageError

GROUP = "quadexp.conf"


@functools.cache
def plugin_folders() -> dict[str, Path]:
    """Configuration folders of installed packages, by the name of their entry point, in the order of the names.

    Raises UsageError where an entry point names no package with a folder.
    """
    found = {}
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.name):
        try:
            spec = importlib.util.find_spec(point.value)
        except ImportError:
            spec = None
        places = list(spec.submodule_search_locations or ()) if spec else []
        if not places:
            raise UsageError(f"entry point {point.name!r} of {GROUP}: no package {point.value!r} that holds a folder")
        found[point.name] = Path(places[0])
    return found


def import_from(folder: Path) -> None:
    """Let modules in a folder be imported, here and in the worker processes that will be started."""
    if str(folder) in sys.path:
        return
    sys.path.append(str(folder))
    known = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = f"{known}{os.pathsep}{folder}" if known else str(folder)
