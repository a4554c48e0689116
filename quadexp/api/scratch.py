"""A temporary folder that lives as long as the objects whose files lie in it."""

from __future__ import annotations

import tempfile
from pathlib import Path


class Scratch:
    """A folder that is removed when nothing refers to it any more, at the latest when Python ends."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="quadexp-", ignore_cleanup_errors=True)

    def __fspath__(self) -> str:
        return self._folder.name

    def __truediv__(self, name: str) -> Path:
        return Path(self._folder.name) / name

    def __reduce__(self) -> tuple[type[Path], tuple[str]]:
        return Path, (self._folder.name,)  # a copy in another process does not own the folder
