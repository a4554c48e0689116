"""Where a result came from: versions, sources, packages, revision, machine, time.

What decides a flight is found by following imports, from the function that flies it and from the classes of its parts:
no list of files is kept. Files beside the rooms of this package (errors, messages, writer, ...) are not followed: they
say, show and store what was flown. Nothing that is followed is imported for it.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions
from pathlib import Path
from typing import Any, NamedTuple

import quadexp
from quadexp.names import sha256_of
from quadexp.plugin import shipped_places

PACKAGES = (
    "casadi", "numpy", "scipy", "pandas", "pyarrow", "torch", "gpytorch", "hydra-core", "minsnap-trajectories",
)  # fmt: skip
NUMERIC = ("python", "casadi", "numpy", "scipy", "torch", "minsnap-trajectories")  # a result row names these
MODULES = {
    "hydra-core": "hydra",
    "minsnap-trajectories": "minsnap_trajectories",
}  # import names that differ from the package name

FLYING = "quadexp.experiment.evaluate"  # flies a cell and makes its row
ROOMS = ("control", "models", "physics", "reference", "world")  # what configurations and checkpoints name is in these,
PLUGINS = "plugins"  # or in plug-ins, where an option or a checkpoint names it
REPORTS = ("report", "page", "drawing")  # rooms, and plug-ins, that report numbers
SHORT = 12  # hex digits of a hash that people read
SETTLED = 2_000_000_000  # ns after a change within which another one may leave the same times: the coarsest disks
RESULTS = ("asked.json", "results.parquet")  # files in folders that a sweep writes
LARGEST = 32_000_000  # bytes of a package whose content is compared; of a larger one the version is
_IMPORT = re.compile(rb"""import(?:\b[ \t]*(\([^)]*\)|[^\n;]*)|(?:_module|__)\(\s*["']([.\w]+)["'])""")
_TEXT = re.compile(rb"[\"']([^\"'\n]{1,255})[\"']")
_COMMENT = re.compile(rb"#[^\n]*")


def package_folder() -> Path:
    """Folder of the running package."""
    return Path(quadexp.__file__).resolve().parent


# ------------------------------------------------------------------------------------------------------------- content
_contents: dict[str, tuple[tuple[int, ...], str]] = {}  # path -> what its entry said, and the hash


def content_hash(path: str | Path) -> str:
    """sha256 of a file. It is read again unless its entry is the same and was old when the file was read: the time of
    the last change, which nobody sets, tells two contents apart unless they were written within one tick of a clock."""
    place = os.fspath(path)
    state = os.stat(place)
    entry = (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
    known = _contents.get(place)
    if known and known[0] == entry:
        return known[1]
    now = time.time_ns()
    with open(place, "rb") as file:
        hashed = sha256_of(file.read())
    if now - state.st_ctime_ns > SETTLED:
        _contents[place] = entry, hashed
    return hashed


def files_hash(files: Iterable[Path], root: Path) -> str:
    """Hash of the names, below `root`, and the contents of some files."""
    lines = sorted(f"{file.relative_to(root).as_posix()} {content_hash(file)}" for file in files)
    return sha256_of("\n".join(lines))


def place_hash(path: Path) -> str:
    """Hash of a file, or of all in a folder."""
    return files_hash(folder_files(path), path) if path.is_dir() else content_hash(path)


def folder_files(folder: Path) -> Iterator[Path]:
    """The files in a folder at any depth, but for Python's own."""
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if name != "__pycache__")
        yield from (Path(place) / name for name in sorted(names) if not name.endswith(".pyc"))


# ------------------------------------------------------------------------------------------------------------- imports
@lru_cache(4096)
def imported_names(name: str, path: Path, content: str) -> frozenset[str]:
    """Modules, or what is in them, that a module imports anywhere in it, in functions too. One that only a comment or a
    docstring imports may be among them, a name that is put together is not. content: hash of its file."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    text = path.read_bytes().replace(b"\\\n", b" ")
    names: set[bytes] = set()
    for match in _IMPORT.finditer(text):
        statement, called = match.groups()
        before = text[text.rfind(b"\n", 0, match.start()) + 1 : match.start()]
        words = before.split()
        listed = _COMMENT.sub(b"", statement or b"").strip(b"()").split(b",")
        items = [item.split()[0] for item in listed if item.strip()]
        if called:
            names.add(called)
        elif len(words) > 1 and words[-2].endswith(b"from") and before[-1:].isspace():
            base = words[-1]
            prefix = base if base.endswith(b".") else base + b"."
            names |= {base, *(prefix + item for item in items)}
        elif not words or words[-1].endswith((b";", b":")):
            names.update(items)
    return frozenset(_absolute(name.decode(errors="replace"), package) for name in names)


def _absolute(name: str, package: str) -> str:
    """A name that may be relative to a package, by leading dots."""
    rest = name.lstrip(".")
    dots = len(name) - len(rest)
    if not dots:
        return name
    parts = package.split(".")
    return ".".join([*parts[: len(parts) + 1 - dots], *filter(None, [rest])])


def named_files(path: Path, folders: Iterable[Path]) -> dict[str, Path]:
    """Files, by their names, that strings in a Python file name, in some folders, in folders there that strings name
    too, or where this process stands; and folders of data there: those without modules, options and results."""
    texts = _named(path, content_hash(path))
    named = {f"./{text}": Path(text) for text in texts if _is_data_file(text)}
    for level, folder in enumerate(folders):
        places = [(folder, "../" * level)]
        for place, prefix in places:
            for text, place_named in ((text, place / text) for text in texts):
                if _is_data_file(place_named):
                    named.setdefault(prefix + text, place_named)
                elif place == folder in Path(os.path.normpath(place_named)).parents and place_named.is_dir():
                    files = [*folder_files(place_named)]
                    if any(file.suffix in (".py", ".yaml") or file.name in RESULTS for file in files):
                        places.append((place_named, f"{prefix}{text}/"))
                    elif files:
                        named.setdefault(prefix + text, place_named)
    return named


@lru_cache(4096)
def _named(path: Path, content: str) -> frozenset[str]:
    """Strings in a file. content: its hash."""
    return frozenset(text.decode(errors="replace") for text in _TEXT.findall(path.read_bytes()))


def _is_data_file(path: str | Path) -> bool:
    return os.path.isfile(path) and not os.fspath(path).endswith(".py")


def follow(names: Iterable[str], locate: Callable[[str], Path | None]) -> tuple[dict[str, Path], set[str]]:
    """Modules that some modules import, themselves too, with those that these import: name -> file; and dotted names
    that lie elsewhere.

    locate: the file of a module, the folder of a package without one, None for what lies elsewhere.
    """
    modules: dict[str, Path] = {}
    elsewhere: set[str] = set()
    waiting = [*names]
    while waiting:
        name = waiting.pop()
        if not name or name in modules or name in elsewhere:
            continue
        parent = name.rpartition(".")[0]
        path = locate(name)
        waiting += [parent] if parent else []
        if path is None:
            elsewhere.add(name)
            continue
        modules[name] = path
        if path.suffix == ".py":
            waiting += imported_names(name, path, content_hash(path))
    return modules, elsewhere


# --------------------------------------------------------------------------------------------- sources of this package
@cache
def shipped_modules(folder: Path) -> dict[str, Path]:
    """Name -> file of the modules in the rooms of this package."""
    modules = {}
    for path in folder_files(folder):
        if path.suffix == ".py" and path.parent != folder:
            parts = path.relative_to(folder.parent).with_suffix("").parts
            modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return modules


def served(*names: str) -> set[str]:
    """The modules of services of plug-ins, of those that are there."""
    services = shipped_places("services")
    return {services[name].partition(":")[0] for name in names if name in services}


@cache
def flying() -> frozenset[str]:
    """The modules that fly every cell."""
    return frozenset({FLYING, *served("loop_margins")})


@cache
def _deciding_modules(folder: Path) -> dict[str, Path]:
    """Those that can decide a number: of what reports one, only what makes a row."""
    modules = shipped_modules(folder)
    followed, _ = follow(flying(), modules.get)
    return {name: path for name, path in modules.items() if name in followed or _room(name) not in REPORTS}


def _room(module: str) -> str:
    """The room, or the plug-in, that a module of this package is in."""
    places = module.split(".")[1:]
    return places[1] if places[0] == PLUGINS and len(places) > 1 else places[0]


@cache
def model_modules(folder: Path) -> frozenset[str]:
    """Modules of models; one is imported by the kind that a checkpoint names."""
    core = {name for name in shipped_modules(folder) if name.startswith("quadexp.models.")}
    return frozenset(core | set(shipped_places("models").values()))


@cache
def _kernels(folder: Path) -> dict[Path, list[Path]]:
    """Module -> files of C beside it that it names."""
    kernels: dict[Path, list[Path]] = {}
    for kernel in (file for file in folder_files(folder) if file.suffix == ".c"):
        for path in kernel.parent.glob("*.py"):
            if kernel.name.encode() in path.read_bytes():
                kernels.setdefault(path, []).append(kernel)
    return kernels


class Program(NamedTuple):
    """sources: hash of the sources of this package behind some modules. packages: names that they import of others."""

    sources: str
    packages: frozenset[str]


@cache
def program_of(modules: frozenset[str]) -> Program:
    """What some modules of this package, and all that they import, are made of; once per process."""
    folder = package_folder()
    followed, elsewhere = follow(modules, _deciding_modules(folder).get)
    kernels = _kernels(folder)
    files = {file for path in followed.values() for file in (path, *kernels.get(path, ()))}
    packages = {name.partition(".")[0] for name in elsewhere} - sys.stdlib_module_names - {"quadexp", ""}
    return Program(files_hash(files, folder)[:SHORT], frozenset(packages))


@cache
def sources() -> str:
    """Hash of the sources that can determine a flight, 12 hex digits; computed once per process."""
    folder = package_folder()
    modules = shipped_modules(folder)
    parts = shipped_places("parts").values()
    rooms = {name for name in modules if _room(name) in ROOMS}
    rooms |= {name for name in modules if any(f"{name}.".startswith(f"{place}.") for place in parts)}
    return program_of(frozenset({*flying(), *rooms, *model_modules(folder)})).sources


@cache
def package_hash() -> str:
    """Hash of all sources of this package, 12 hex digits: a worker must have the same as the driver."""
    folder = package_folder()
    return files_hash((file for file in folder_files(folder) if file.suffix in (".py", ".c")), folder)[:SHORT]


def identity() -> dict[str, str]:
    """What must be equal in all processes of a sweep: versions, and the hash of the sources of this package."""
    return {**versions(), "sources": package_hash()}


# ------------------------------------------------------------------------------------------------------ other packages
def numeric_versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions of those among some packages, by import name, that can change a number."""
    names = {MODULES.get(package, package): package for package in PACKAGES}
    return {name: versions().get(names[name], "") for name in packages if name in names}


def package_identity(name: str) -> str:
    """Hash of the content of an installed package or module; the version of a large one, "" where there is none. It is
    not imported."""
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # of a module that was made without one
        return ""
    places: Iterable[str | None] = spec.submodule_search_locations or [spec.origin] if spec else []
    hashes = []
    size = 0
    for place in (Path(place) for place in places if place):
        files = []
        for file in folder_files(place) if place.is_dir() else [place]:
            files.append(file)
            size += file.stat().st_size
            if size > LARGEST:
                return distribution(packages_distributions().get(name, [name])[0]).version
        hashes.append(files_hash(files, place.parent))
    return " ".join(hashes)


@cache
def versions() -> dict[str, str]:
    """Version of this program, of Python, and of the packages that can change a number.

    A module that is imported from another place than its installed package is listed with its file.
    """
    numbers = {"quadexp": quadexp.__version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            installed = distribution(package)
        except PackageNotFoundError:
            continue
        elsewhere = _elsewhere(MODULES.get(package, package), Path(str(installed.locate_file(""))))
        stated = re.search(r"^Version: (\S+)$", installed.read_text("METADATA") or "", re.MULTILINE)
        number = stated[1] if stated else installed.version  # which parses all of it as an e-mail
        numbers[package] = number + (f" (imported from {elsewhere})" if elsewhere else "")
    return numbers


def _elsewhere(module: str, installed: Path) -> str:
    """File of a module that is not imported from its installed package, "" for one that is."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return ""
    origin = spec.origin if spec else None
    if origin is None or Path(origin).resolve().is_relative_to(installed.resolve()):
        return ""
    return origin


def libraries(known: Mapping[str, str] | None = None) -> str:
    """The versions that can change a number of a flight, in one line; known: of a file's record, else this process."""
    known = versions() if known is None else known
    return ", ".join(f"{name} {known[name]}" for name in NUMERIC if name in known)


@cache
def revision() -> dict[str, Any]:
    """Git commit of the checkout this package lies in, and whether it has changes; empty when installed elsewhere."""
    root = Path(quadexp.__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return {}
    commit = _git(root, "rev-parse", "HEAD")
    if commit is None:
        return {}
    return {"commit": commit, "dirty": bool(_git(root, "status", "--porcelain", "--", "quadexp", "conf"))}


def _git(root: Path, *arguments: str) -> str | None:
    try:
        command = ["git", "-C", str(root), *arguments]
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


@cache
def processor() -> str:
    """Model name of the processor."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def provenance() -> dict[str, Any]:
    """Metadata of every file beside its configuration."""
    return {
        "git": revision(),
        "platform": f"{platform.system()} {platform.machine()}",
        "cpu": processor(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }
