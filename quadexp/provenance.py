"""Where a result came from: versions, revision, machine, time."""

from __future__ import annotations

import platform
import subprocess
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import quadexp

PACKAGES = ("casadi", "numpy", "scipy", "pandas", "pyarrow", "torch", "gpytorch", "hydra-core")


@cache
def versions() -> dict[str, str]:
    """Version of this program, of Python, and of the packages that can change a number."""
    found = {"quadexp": quadexp.__version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


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
    """What stands in every file's metadata beside the configuration."""
    return {
        "git": revision(),
        "platform": f"{platform.system()} {platform.machine()}",
        "cpu": processor(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }
