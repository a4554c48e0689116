"""Modules of a user's folder, or of a plugin package: where they lie, and their code as it is now.

A user's own lie in a folder given with --conf, or in an installed package that offers its configuration folder, laid
out as conf/ is, by an entry point:

    [project.entry-points."quadexp.conf"]
    my_lab = "my_lab.conf"

They are executed from their text, never from bytecode, which Python tells from its source by seconds and size only.
Where the text of a module has changed since, or data that it names, or those of one that it imports, or where a module
of that name from another folder is loaded, all are executed anew, each in the module object that it had, as
importlib.reload does: a flight in this process has the code that a worker process imports.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import sys
from collections.abc import Iterable, Sequence
from importlib.machinery import EXTENSION_SUFFIXES, ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import ModuleType

from quadexp.errors import QuadexpError, UsageError
from quadexp.names import sha256_of
from quadexp.plugin import ENTRY_POINTS as PLUGINS
from quadexp.plugin import entry_points
from quadexp.provenance import content_hash, follow, named_files, place_hash

OWN = "quadexp"  # the package whose classes any option may name
ENTRY_POINTS = "quadexp.conf"  # group of the entry points of plugin packages
BRANCHES = (
    "`if`, `and`, `or`, `max` and `min` need numbers, and this is an expression: write ca.if_else(CONDITION, A, B),"
    " ca.logic_and, ca.logic_or, ca.fmax, ca.fmin"
)
# What a library says of a mistake that is often made -> what to write instead.
ADVICE = {
    "truth value of a CasADi": BRANCHES,
    "truth value of a numeric MX": BRANCHES,
    "could have a truth value": BRANCHES,
    "not iterable by design": "max, min, sum and sorted are ca.mmax, ca.mmin, ca.sum1 and ca.sort",
    "'to_double' not defined": "math.sqrt and float need numbers, and this is an expression: write ca.sqrt",
    "relative import with no known parent": "a module imports another one of its folder by its name: import helper",
    "non-frozen dataclass": "the decorator is: dataclass(frozen=True, kw_only=True)",
}

_folders: list[Path] = []  # given with --conf
_places: dict[str, Path] = {}  # file, or folder without one, of modules that are executed here
_texts: dict[str, str] = {}  # hash of the text that a module was executed from
_data: dict[str, dict[str, str]] = {}  # and of data that it may have read then
_objects: dict[Path, ModuleType] = {}  # module object of a file, in which it is executed again
_state = {"generation": 0, "mixed": False}  # mixed: one was executed again alone, which others had imported from


# --------------------------------------------------------------------------------------------------------------- places
def own_folders() -> tuple[str, ...]:
    """The folders given with --conf, for the worker processes that this process starts."""
    return tuple(map(str, _folders))


def import_from(*folders: str | Path) -> None:
    """Let modules in some folders be imported, and named under `_target_`, in this process; those in folders that were
    given before are not any longer."""
    if own_folders() == tuple(map(str, folders)):
        return
    for folder in own_folders():
        if folder in sys.path:
            sys.path.remove(folder)
    _folders[:] = map(Path, folders)
    sys.path += [folder for folder in own_folders() if folder not in sys.path]
    _taken.cache_clear()


@functools.cache
def plugin_folders() -> dict[str, Path]:
    """Configuration folders of installed packages, by the name of their entry point, in the order of the names.

    Raises UsageError where an entry point names no package with a folder.
    """
    folders = {}
    for name, value in sorted(entry_points(ENTRY_POINTS).items()):
        try:
            spec = importlib.util.find_spec(value)
        except ImportError:
            spec = None
        places = list(spec.submodule_search_locations or ()) if spec else []
        if not places:
            said = f"entry point {name!r} of {ENTRY_POINTS}"
            raise UsageError(f"{said}: no package {value!r} that holds a folder")
        folders[name] = Path(places[0])
    return folders


@functools.cache
def _plugin_places() -> dict[str, Path]:
    """Names of plugin packages, the outermost, and the folder that each lies in."""
    places = {}
    for value in entry_points(ENTRY_POINTS).values():
        top = value.partition(".")[0]
        spec = importlib.util.find_spec(top)
        inside = list(spec.submodule_search_locations or ()) if spec else []
        if inside:
            places[top] = Path(inside[0]).parent
    return places


def locate(name: str) -> Path | None:
    """The file of a user's module, the folder of a package without one; None for what is no user's.

    Raises UsageError where two --conf folders have other modules of that name."""
    top = name.partition(".")[0]
    plugin = _plugin_places().get(top)
    places = []
    for folder in [plugin] if plugin else _folders:
        base = folder.joinpath(*name.split("."))
        files = [base / "__init__.py", *(base.with_name(base.name + suffix) for suffix in (".py", *EXTENSION_SUFFIXES))]
        places.append(next(filter(Path.is_file, files), base))
    places = sorted(filter(Path.exists, places), key=Path.is_dir)
    if not places or (plugin is None and _taken(top)):
        return None
    first, *others = (path for path in places if path.is_file() == places[0].is_file())
    if first.is_file() and (other := next((o for o in others if content_hash(o) != content_hash(first)), None)):
        raise UsageError(f"the name {name} stands for {first} and for {other}: give one of these modules another one")
    return first


def data_of(name: str, path: Path) -> dict[str, Path]:
    """Files of data that a user's module names: beside it, and above it as far as its --conf folder, or its package."""
    levels = name.count(".") + (path.stem == "__init__") - (name.partition(".")[0] in _plugin_places())
    return named_files(path, dict.fromkeys([*path.parents[: levels + 1], path.resolve().parent]))


def _contents(name: str, path: Path) -> dict[str, str]:
    return {text: place_hash(place) for text, place in data_of(name, path).items()}


def lies_outside(module: str) -> str:
    """Why a module is none of a --conf folder or of an installed plugin package; "" where it is one. It is not
    imported."""
    for value in entry_points(ENTRY_POINTS).values():
        package = value.rpartition(".")[0] or value
        if f"{module}.".startswith(f"{package}."):
            return ""
    first = module.partition(".")[0]
    if any(_within(folder, first) for folder in _folders):
        taken = _taken(first)
        said = f"the name {first} is taken by {taken}: give the module in the --conf folder another one"
        return said if taken else ""
    where = f"the --conf folder {_folders[-1]}" if _folders else "a --conf folder (none is given)"
    return f"there is no module {first} in {where}, nor in an installed package with an entry point of {ENTRY_POINTS}"


def _within(folder: Path, top: str) -> list[str]:
    return _places_of(PathFinder.find_spec(top, [str(folder)]))


@functools.cache
def _taken(top: str) -> str:
    """What Python imports under a name rather than what lies in a user's folder, "" for nothing."""
    for finder in sys.meta_path:
        spec = None if finder is _finder else finder.find_spec(top, None)
        if places := _places_of(spec):
            ours = {Path(place).resolve() for folder in _folders for place in _within(folder, top)}
            return "" if Path(places[0]).resolve() in ours else places[0]
    return ""


def _places_of(spec: ModuleSpec | None) -> list[str]:
    if spec is None:
        return []
    return [spec.origin] if spec.origin else list(spec.submodule_search_locations or ())


# ----------------------------------------------------------------------------------------------------------------- code
def modules_of(names: Iterable[str]) -> tuple[dict[str, str], set[str], dict[str, Path]]:
    """The user's modules among some modules and all that these import: name -> hash of the text that they were executed
    from, or would be; dotted names of others that they import; and name -> file."""
    modules, elsewhere = follow(names, locate)
    files = {name: path for name, path in modules.items() if path.is_file()}
    return {name: _texts.get(name) or content_hash(path) for name, path in files.items()}, elsewhere, files


def place_of(error: BaseException) -> str:
    """Where in a user's module an error came up, as FILE, line N; "" where none was running."""
    files = set(map(str, _places.values()))
    packages = {value.partition(".")[0].partition(":")[0] for value in entry_points(PLUGINS).values()}
    place = ""
    trace = error.__traceback__
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        module = str(trace.tb_frame.f_globals.get("__name__"))
        if file in files or module.partition(".")[0] in packages:
            place = f"{Path(file).name}, line {trace.tb_lineno}"
        trace = trace.tb_next
    return place


def fault(error: BaseException) -> str:
    """An error that came up in a user's module in one line: where, what was raised, and what to write instead."""
    text = " ".join(str(error).split())[:300]
    advice = next((words for said, words in ADVICE.items() if said in text), "")
    kind = "" if isinstance(error, QuadexpError) else type(error).__name__
    place = "" if isinstance(error, SyntaxError) else place_of(error)  # whose text says it
    raised = ": ".join(filter(None, (place, kind, text)))
    return f"{raised}; {advice}" if advice else raised


def generation() -> int:
    """How often modules were executed anew: what was made of their classes before is not to be used again."""
    return _state["generation"]


def load(name: str) -> ModuleType:
    """A user's module, as its files are now; any other as Python imports it. Raises what importing it raises."""
    modules = {} if name.partition(".")[0] == OWN else follow([name], locate)[0]
    if _state["mixed"] or any(_differs(name, path) for name, path in modules.items()):
        _forget({*modules, *_places})
    _places.update(modules)
    if modules and _finder not in sys.meta_path:
        sys.meta_path.insert(0, _finder)
    if name not in sys.modules:
        importlib.invalidate_caches()
    return importlib.import_module(name)


def _differs(name: str, path: Path) -> bool:
    """Whether another module than the one in a file is loaded under a name, or another text of it."""
    module = sys.modules.get(name)
    if module is None:
        return False
    if path.is_dir():
        return str(path) not in getattr(module, "__path__", ())
    if path.suffix == ".py":
        changed = _places.get(name) != path or _texts.get(name) != content_hash(path)
        return changed or _data[name] != _contents(name, path)
    return getattr(module, "__file__", None) != str(path)  # compiled, which is loaded once


def _forget(names: set[str]) -> None:
    """Have modules executed anew where they are imported next."""
    for name in names:
        module = sys.modules.pop(name, None)
        if module is not None and module.__file__:
            _objects[Path(module.__file__)] = module
    _places.clear()
    _texts.clear()
    _state.update(generation=_state["generation"] + 1, mixed=False)


class _Loader(SourceFileLoader):
    """Executes the text of a file."""

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        module = _objects.pop(Path(self.path), None)
        if module is not None:
            vars(module).clear()
        return module

    def exec_module(self, module: ModuleType) -> None:
        text = self.get_data(self.path)
        _state["mixed"] |= self.name in _texts  # by importlib.reload
        _texts[self.name] = sha256_of(text)
        _data[self.name] = _contents(self.name, Path(self.path))
        try:
            exec(self.source_to_code(text, self.path), vars(module))
        except BaseException:
            del _texts[self.name]
            raise


class _Finder:
    """Finds what `load` has found, before Python does."""

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: object = None) -> ModuleSpec | None:
        place = _places.get(name)
        if place is None or place.suffix != ".py":
            return None if place is None else PathFinder.find_spec(name, [str(place.parent)])
        within = [str(place.parent)] if place.name == "__init__.py" else None
        loader = _Loader(name, str(place))
        return importlib.util.spec_from_file_location(name, place, loader=loader, submodule_search_locations=within)


_finder = _Finder()
