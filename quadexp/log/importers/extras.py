"""What to say where a format needs a package that is not installed."""

from __future__ import annotations

from pathlib import Path

from quadexp.errors import UsageError


def missing_package(path: Path, package: str, extra: str) -> UsageError:
    """The error for a log whose reader is in an extra that is not installed."""
    return UsageError(f"{path}: needs the package {package}; install it with: pip install 'quadexp[{extra}]'")
