"""Cells of a sweep on disk: one flight file per cell, named by the hash of everything that decides it.

    <results>/cells/<2 hex>/<key>.parquet
    <results>/cells/asked.json               keys of cells that were asked for and that no table lists yet

A cell is done when its file exists and holds, byte for byte, what was written; a file appears complete or not at all,
but for a power cut before the sweep's end, after which some may be damaged and are flown again.
Nothing else is kept between runs.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from quadexp.errors import DataError, UsageError
from quadexp.log.store import read_record
from quadexp.names import check_names
from quadexp.writer import check_output, clean, write_text

MARK = "cells"
ASKED = "asked.json"


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
        self.folder.mkdir(parents=True, exist_ok=True)

    @property
    def is_frozen(self) -> bool:
        """Whether it is there and takes no files, as on a disk that can only be read."""
        return self.folder.is_dir() and not os.access(self.folder, os.W_OK)

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
        names = (entry.name for folder in self._folders() for entry in os.scandir(folder))
        return {name.removesuffix(".parquet") for name in names if name.endswith(".parquet")}

    def asked(self) -> set[str]:
        """Keys of the cells that a run asked for which has not ended, or makes no table; raises DataError where their
        list cannot be read."""
        path = self.folder / ASKED
        try:
            return {str(key) for key in json.loads(path.read_text(encoding="utf-8"))}
        except FileNotFoundError:
            return set()
        except (OSError, ValueError, TypeError) as error:
            raise DataError(f"{path}: says which flights are still wanted, and cannot be read") from error

    def ask(self, keys: Iterable[str]) -> None:
        """Note that these cells are asked for, before the first is flown. A list that cannot be read is left as it is:
        then nothing is pruned."""
        with contextlib.suppress(DataError):
            self._write_asked(self.asked().union(keys))

    def listed(self, keys: Iterable[str]) -> None:
        """Note that a table lists these cells."""
        with contextlib.suppress(DataError):
            self._write_asked(self.asked().difference(keys))

    def _write_asked(self, keys: set[str]) -> None:
        path = self.folder / ASKED
        if keys:
            write_text(path, json.dumps(sorted(keys)))
        else:
            path.unlink(missing_ok=True)

    def row(self, key: str, log_period: float = math.inf) -> dict[str, Any]:
        """Result row of a cell; raises as `record` does."""
        return dict(self.record(key, log_period)["row"])

    def record(self, key: str, log_period: float = math.inf) -> dict[str, Any]:
        """Record of a cell's file, every byte of which is checked.

        log_period: largest time (s) between samples of a flight thinned by evaluate.log_period that will do.
        Raises DataError where the file has changed since it was written, holds another flight, or too few samples.
        """
        record = read_record(self.path(key), "flight")
        if record.get("key") != key or "row" not in record:
            raise DataError(f"{self.path(key)}: holds another flight than its name says")
        if (stored := record.get("thinned", {}).get("log_period", 0.0)) > log_period:
            raise DataError(f"{self.path(key)}: holds a sample every {stored:g} s only")
        check_names(record, str(self.path(key)))
        return record

    def remove(self, keys: Iterable[str]) -> None:
        for key in keys:
            self.path(key).unlink(missing_ok=True)

    def clean(self) -> None:
        """Remove unfinished files of an interrupted run (call it with the lock held)."""
        for folder in (self.root, self.folder, *self._folders()):
            clean(folder)

    @contextlib.contextmanager
    def emptied(self) -> Iterator[None]:
        """Remove the folders again if the block fails before any file was written."""
        try:
            yield
        except BaseException:
            if not self.done():
                (self.folder / ASKED).unlink(missing_ok=True)
            for folder in (*self._folders(), self.folder, self.root):
                with contextlib.suppress(OSError):  # it holds something
                    if folder != self.folder or os.listdir(self.root) == [MARK]:  # which tells what a folder is
                        folder.rmdir()
            raise

    def _folders(self) -> list[Path]:
        """The folders that cells lie in."""
        return [path for path in self.folder.iterdir() if path.is_dir()] if self.folder.is_dir() else []
