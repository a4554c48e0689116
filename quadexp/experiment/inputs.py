"""Where a file that a flight reads lies on this machine.

A configuration names its files as they lie where the sweep was started, and so do the records of its flights. A worker
elsewhere gets a copy, and says here where that is.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

_copies: dict[str, str] = {}


def use_copies(copies: Mapping[str, str]) -> None:
    """From now on read these: path as configured -> path of its copy. Earlier copies are forgotten."""
    _copies.clear()
    _copies.update(copies)


def located(path: str | Path) -> Path:
    """Where to read what is configured as `path`."""
    return Path(_copies.get(str(path), path))
