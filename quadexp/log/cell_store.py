"""Cells of a sweep on disk: one flight file per cell, named by the hash of everything that decides it.

    <results>/cells/<2 hex>/<key>.parquet

A cell is done when its file exists and holds, byte for byte, what was written; a file appears complete or not at all.
Nothing else is kept between runs.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from quadexp.errors import DataError, UsageError
from quadexp.log.store import check_output, read_record

MARK = "cells"


class CellStore:
    """The cells of one results folder."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)
        self.folder = self.root / MARK

    def open(self) -> None:
        """Make the folder; raises UsageError for one that holds other files or cannot be written."""
        if self.root.is_dir() and any(self.root.iterdir()) and not self.folder.is_dir():
            raise UsageError(f"{self.root}: is a folder of other things, not of results: choose another --out")
        check_output(self.root, folder=True, force=True)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{self.folder}: cannot be written ({error.strerror})") from None

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Refuse a second sweep in this folder while one runs; raises UsageError."""
        with open(self.folder / ".lock", "w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                theirs = not os.path.samestat(os.fstat(file.fileno()), os.stat(file.name))
            except (BlockingIOError, FileNotFoundError):  # held by another process, or removed by it just before
                theirs = True
            except OSError:  # a file system without locks, as on some clusters
                theirs = False
            if theirs:
                raise UsageError(f"{self.root}: another sweep is running there: choose another --out")
            try:
                yield
            finally:
                with contextlib.suppress(OSError):
                    os.unlink(file.name)

    def path(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}.parquet"

    def done(self) -> set[str]:
        """Keys of the cells that have a file, whatever it holds."""
        return {entry.name.removesuffix(".parquet") for entry in self._entries() if entry.name.endswith(".parquet")}

    def row(self, key: str) -> dict[str, Any]:
        """Result row of a cell, from the record of its file, every byte of which is checked.

        Raises DataError where the file has changed since it was written, or holds another flight.
        """
        record = read_record(self.path(key), "flight")
        if record.get("key") != key or "row" not in record:
            raise DataError(f"{self.path(key)}: holds another flight than its name says")
        return record["row"]

    def remove(self, keys: Iterable[str]) -> None:
        for key in keys:
            self.path(key).unlink(missing_ok=True)

    def clean(self) -> None:
        """Remove unfinished files of an interrupted run (call it with the lock held)."""
        for entry in self._entries():
            if entry.name.endswith(".tmp"):
                Path(entry.path).unlink(missing_ok=True)
        for path in self.root.glob(".*.tmp"):
            path.unlink(missing_ok=True)

    @contextlib.contextmanager
    def emptied(self) -> Iterator[None]:
        """Remove the folders again if the block fails before any file was written."""
        try:
            yield
        except BaseException:
            if self.root.is_dir() and not any(path.is_file() for path in self.root.rglob("*")):
                shutil.rmtree(self.root, ignore_errors=True)
            raise

    def _entries(self) -> Iterator[os.DirEntry[str]]:
        for folder in os.scandir(self.folder) if self.folder.is_dir() else ():
            if folder.is_dir():
                yield from os.scandir(folder.path)
