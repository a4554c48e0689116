"""What to say where a format needs a package of an extra that is not installed."""

from __future__ import annotations

from pathlib import Path

from quadexp.errors import UsageError


def missing_package(what: str | Path, package: str, extra: str) -> UsageError:
    """The error for a log or a format whose package is in an extra that is not installed."""
    return UsageError(f"{what}: needs the package {package}; install it with: pip install 'quadexp[{extra}]'")
