"""Where a result came from: versions, sources, revision, machine, time.

DECIDING lists the sources that determine the result of a flight; tests/test_provenance.py compares it with what
`evaluate_cell` imports. Not listed are sources that compose and check a configuration (their result is in the key of
the cell), and that store, report or distribute flights. `models` is listed whole, though a fit that was done before
decides nothing (the content of a checkpoint is in the key): a model's equation and its fit stand in one file.
`report/metrics.py` is listed, because the figures of a row are computed once, when the cell is flown.
"""

from __future__ import annotations

import hashlib
import importlib.util
import platform
import re
import subprocess
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import quadexp

PACKAGES = (
    "casadi", "numpy", "scipy", "pandas", "pyarrow", "torch", "gpytorch", "hydra-core", "minsnap-trajectories",
)  # fmt: skip
NUMERIC = ("python", "casadi", "numpy", "scipy", "torch", "minsnap-trajectories")  # a result row names these
MODULES = {
    "hydra-core": "hydra",
    "minsnap-trajectories": "minsnap_trajectories",
}  # import names that differ from the package name

# Folders (with all their files) and files whose content determines a flight and the figures of its row.
DECIDING = (
    "compile", "control", "models", "physics", "reference", "world", "experiment/build.py",
    "experiment/compiled_flight.py", "experiment/evaluate.py", "experiment/flight.c",
    "experiment/identity.py", "experiment/loop_margins.py",
    "experiment/rollout.py", "log/outcome.py", "report/metrics.py",
)  # fmt: skip
SUFFIXES = (".py", ".c")
SHORT = 12  # hex digits of a hash that people read


def package_folder() -> Path:
    """Folder of the running package."""
    return Path(quadexp.__file__).resolve().parent


@cache
def sources() -> str:
    """Hash of the sources that determine a flight (see the module), 12 hex digits; computed once per process."""
    return source_hash(package_folder() / name for name in DECIDING)


@cache
def package_hash() -> str:
    """Hash of all sources of this package, 12 hex digits: a worker must have the same as the driver."""
    return source_hash([package_folder()])


def identity() -> dict[str, str]:
    """What must be equal in all processes of a sweep: versions, and the hash of the sources of this package."""
    return {**versions(), "sources": package_hash()}


def source_hash(places: Iterable[Path]) -> str:
    """Hash of the sources in some folders and files of this package, 12 hex digits."""
    root = package_folder()
    files = {
        file
        for place in places
        for file in (place.rglob("*") if place.is_dir() else [place])
        if file.suffix in SUFFIXES and file.is_file()
    }
    digest = hashlib.sha256()
    for file in sorted(files):
        content = file.read_bytes()
        digest.update(f"{file.relative_to(root).as_posix()}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()[:SHORT]


@cache
def versions() -> dict[str, str]:
    """Version of this program, of Python, and of the packages that can change a number.

    A module that is imported from another place than its installed package is listed with its file.
    """
    found = {"quadexp": quadexp.__version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            installed = distribution(package)
        except PackageNotFoundError:
            continue
        elsewhere = _elsewhere(MODULES.get(package, package), Path(str(installed.locate_file(""))))
        stated = re.search(r"^Version: (\S+)$", installed.read_text("METADATA") or "", re.MULTILINE)
        number = stated[1] if stated else installed.version  # which parses all of it as an e-mail
        found[package] = number + (f" (imported from {elsewhere})" if elsewhere else "")
    return found


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


def libraries(found: Mapping[str, str] | None = None) -> str:
    """The versions that can change a number of a flight, in one line; found: of a file's record, else this process."""
    found = versions() if found is None else found
    return ", ".join(f"{name} {found[name]}" for name in NUMERIC if name in found)


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
