"""Location of a flight's input files on this machine.

A configuration and the metadata of its flights have the paths of the machine on which the sweep was started. A worker
on another machine gets copies and registers their paths here.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

_copies: dict[str, str] = {}


def use_copies(copies: Mapping[str, str]) -> None:
    """Set the map from configured path to path of the copy, replacing an earlier one."""
    _copies.clear()
    _copies.update(copies)


def located(path: str | Path) -> Path:
    """The path to read for the configured `path`."""
    return Path(_copies.get(str(path), path))
