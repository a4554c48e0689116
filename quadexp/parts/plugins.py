"""Configuration that comes from outside: installed packages, and the folder given with --conf.

A package offers options of its own (vehicles, plants, trajectories, controllers, experiments) by an entry point of the
group `quadexp.conf` whose value is the package that holds the folders, laid out as conf/ is:

    [project.entry-points."quadexp.conf"]
    my_lab = "my_lab.conf"

`_target_` calls what lies in one of these places and nothing else, so that a configuration file alone cannot name code
that nobody meant to run; a --conf folder with modules in it is code.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import sys
from importlib.machinery import ModuleSpec, PathFinder
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


_own: list[Path] = []  # folders given with --conf


def own_folders() -> tuple[str, ...]:
    """The folders given with --conf in this process, for the worker processes that it starts."""
    return tuple(map(str, _own))


def import_from(folder: Path) -> None:
    """Let modules in a folder be imported, and named under `_target_`, in this process."""
    if folder not in _own:
        _own.append(folder)
    if str(folder) not in sys.path:
        sys.path.append(str(folder))


def lies_outside(module: str) -> str:
    """Why a module is none of a --conf folder or of an installed plugin package; "" where it is one. It is not
    imported."""
    for point in entry_points(group=GROUP):
        package = point.value.rpartition(".")[0] or point.value
        if f"{module}.".startswith(f"{package}."):
            return ""
    first = module.partition(".")[0]
    mine = [place for folder in _own for place in _places(PathFinder.find_spec(first, [str(folder)]))]
    if mine:
        taken = _places(_spec_in_use(first))
        if not taken or any(_same(a, b) for a in mine for b in taken):
            return ""
        return f"the name {first} is taken by {taken[0]}: give the module in the --conf folder another one"
    where = f"the --conf folder {_own[-1]}" if _own else "a --conf folder (none is given)"
    return f"there is no module {first} in {where}, nor in an installed package with an entry point of {GROUP}"


def _spec_in_use(name: str) -> ModuleSpec | None:
    """What Python takes for a top-level module of this name."""
    if name in sys.modules:
        return getattr(sys.modules[name], "__spec__", None)
    return importlib.util.find_spec(name)


def _places(spec: ModuleSpec | None) -> list[str]:
    if spec is None:
        return []
    return [spec.origin] if spec.origin else list(spec.submodule_search_locations or ())


def _same(a: str, b: str) -> bool:
    return os.path.exists(a) and os.path.exists(b) and os.path.samefile(a, b)
