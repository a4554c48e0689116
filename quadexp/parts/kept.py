"""Compositions that are kept between runs, so that Hydra composes each choice of options once.

An entry is named by the hash of all that decides it: the files of the folders, the sources of this room,
the versions of Hydra and OmegaConf, and what was asked for. So an entry is never stale, and one that was changed by
hand, or cannot be read, is made anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from quadexp.errors import QuadexpError, UsageError, WriteError
from quadexp.files.cache import CONFIGURATIONS, cache_folder
from quadexp.files.writer import written
from quadexp.parts.plain_data import read_regular

MOST_FILES = 2000  # in the folders of a configuration; with more, nothing is kept
MOST_ENTRIES = 2000  # of which the older half goes


class KeptCompositions:
    """What Hydra made of these folders. Nothing is kept where the cache folder takes no files."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._base = _digest_of(folders)

    def get(self, asked: Sequence[Any]) -> dict[str, Any] | None:
        """The content that was made for `asked`, or None."""
        path = self._path(asked)
        if path is None:
            return None
        try:
            digest, _, text = path.read_text(encoding="utf-8").partition("\n")
            if hashlib.sha256(text.encode()).hexdigest() == digest:
                return dict(json.loads(text))
        except (OSError, ValueError):
            pass
        return None

    def put(self, asked: Sequence[Any], content: dict[str, Any]) -> None:
        """Keep the content, if JSON can hold it."""
        path = self._path(asked)
        if path is None:
            return
        try:
            text = json.dumps(content)
            if json.loads(text) != content:
                return
        except (TypeError, ValueError):  # such as a date
            return
        with contextlib.suppress(OSError, UnicodeError, WriteError):
            with written(path, durable=False) as file:  # its hash tells a damaged one
                file.write(f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}".encode())
            _thin(path.parent)

    def _path(self, asked: Sequence[Any]) -> Path | None:
        if self._base is None:
            return None
        try:
            folder = cache_folder().inside
        except QuadexpError:
            return None
        key = hashlib.sha256(f"{self._base}{json.dumps(asked)}".encode()).hexdigest()[:40]
        return folder / CONFIGURATIONS / f"{key}.json"


def _digest_of(folders: Sequence[Path]) -> str | None:
    """Hash of what decides any composition; None where there are too many files to look at."""
    digest = hashlib.sha256(f"{version('hydra-core')}\0{version('omegaconf')}".encode())
    sources = [(path.name, path) for path in Path(__file__).parent.glob("*.py")]
    found = [sources, *(list(_files(folder)) for folder in folders)]
    if sum(map(len, found)) > MOST_FILES:
        return None
    for files in found:
        for name, path in sorted(files):
            try:
                content = read_regular(path)
            except (OSError, UsageError):  # no file of the configuration either
                continue
            digest.update(f"{name}\0{len(content)}\0".encode(errors="surrogateescape"))
            digest.update(content)
        digest.update(b"\0\0")
    return digest.hexdigest()


def _files(folder: Path) -> Iterable[tuple[str, Path]]:
    """The configuration files below a folder, with their names in it; of a large folder only too many."""
    looked_at = 0
    for place, _, names in os.walk(folder):
        for name in names:
            looked_at += 1
            if name.endswith(".yaml") or looked_at > MOST_FILES:
                path = Path(place, name)
                yield str(path.relative_to(folder)), path
        if looked_at > 2 * MOST_FILES:
            return


def _thin(folder: Path) -> None:
    """Remove the older half of too many entries."""
    entries = list(os.scandir(folder))
    if len(entries) > MOST_ENTRIES:
        entries.sort(key=lambda entry: entry.stat().st_mtime)
        for entry in entries[: len(entries) // 2]:
            os.unlink(entry.path)
