"""The one writer: a file or a folder takes its name whole or not at all.

The content goes into a new file of a random name in the folder that it will lie in and is flushed to the disk. Then it
takes its name. With `force` this is rename(2), which replaces what is there; of a link the link, not its target.
Without, it is link(2), which fails if the name is taken: of two programs that write the same new file one is refused.
Where a file system has no hard links, an empty file takes the name first. A folder takes its name by rename(2), which
replaces no folder that holds something.

A temporary is called .quadexp-<16 hex digits>.tmp. `clean` removes what killed writers left.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import re
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from quadexp.errors import UsageError, write_error

TEMPORARY = re.compile(r"\.quadexp-[0-9a-f]{16}\.tmp")
ABANDONED = 86400.0  # s after its last change that no writer is at work on a temporary any more
_NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)


def check_output(path: str | Path, *, force: bool = False, folder: bool = False) -> Path:
    """Make sure that `path` can be written, before hours of work: the folder it will lie in takes files, and nothing is
    in the way unless `force`. Nothing is made.

    folder: whether `path` is to be a directory (an existing empty one is nothing in the way).
    Raises UsageError.
    """
    path = Path(path)
    try:
        str(path).encode()
        if folder and path.is_file():
            raise UsageError(f"{path}: is a file, a folder is needed here: choose another --out")
        if not folder and path.is_dir():
            raise UsageError(f"{path}: is a folder, a file name is needed here: choose another --out")
        if path.exists() and not path.is_dir() and not path.is_file():
            raise UsageError(f"{path}: is a device or a pipe, not a file: choose another --out")
        occupied = any(path.iterdir()) if folder and path.is_dir() else os.path.lexists(path)
        if occupied and not force:
            raise taken(path)
        above = [path, *path.absolute().parents] if folder else list(path.absolute().parents)
        nearest = next(parent for parent in above if parent.exists())
        tempfile.TemporaryFile(dir=nearest).close()
    except OSError as error:
        raise UsageError(f"{path}: cannot be written there ({error.strerror}): choose another --out") from None
    except UnicodeEncodeError:
        name = os.fsencode(path).decode(errors="backslashreplace")
        raise UsageError(f"{name}: the name is not UTF-8: choose another --out") from None
    return path


def taken(path: Path) -> UsageError:
    return UsageError(f"{path}: exists already; pass --force to replace it, or choose another --out")


@contextlib.contextmanager
def written(path: str | Path, *, force: bool = True, durable: bool = True) -> Iterator[BinaryIO]:
    """A file, open for reading and writing, that becomes `path` on leaving without an error.

    force: replace an existing file. durable: flush it to the disk first.
    Raises UsageError where `path` is taken (without force), WriteError where it cannot be written.
    """
    path = Path(path)
    temporary = _temporary(path.parent)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "x+b") as file:
            try:
                yield file
                file.flush()
                if durable:
                    os.fsync(file.fileno())
                _take_name(temporary, path, force)
            finally:
                temporary.unlink(missing_ok=True)
    except OSError as error:
        raise write_error(path, error) from error


def flush(folder: Path) -> None:
    """Have the disk hold what was written without `durable` on the file system of a folder, of this machine."""
    syncfs = getattr(ctypes.CDLL(None), "syncfs", None)
    fd = os.open(folder, os.O_RDONLY)
    try:
        if syncfs is None or syncfs(fd):
            os.sync()
    finally:
        os.close(fd)


def write_text(path: str | Path, text: str, *, force: bool = True) -> Path:
    """Write a text file, whole or not at all; see `written`."""
    with written(path, force=force) as file:
        file.write(text.encode())
    return Path(path)


def write_folder(path: Path, files: Mapping[str, str | bytes], *, force: bool = True) -> Path:
    """Write a folder of files, texts or bytes. A new one appears whole; in one that is there the files take their names
    once all are written, the last one first. Raises as `written` does."""
    temporary = _temporary(path.parent)
    try:
        if path.is_dir():
            with contextlib.ExitStack() as stack:
                for name, text in files.items():
                    stack.enter_context(written(path / name, force=force)).write(_bytes(text))
            return path
        clean(path.parent, older=ABANDONED)
        temporary.mkdir(parents=True)
        try:
            for name, text in files.items():
                with written(temporary / name) as file:
                    file.write(_bytes(text))
            os.rename(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise taken(path) if error.errno in (errno.ENOTEMPTY, errno.EEXIST) else write_error(path, error) from error
    return path


def clean(folder: Path, older: float = 0.0) -> None:
    """Remove what killed writers left in a folder. older: s since the last change; 0 where no writer is at work."""
    for entry in os.scandir(folder) if folder.is_dir() else ():
        if not TEMPORARY.fullmatch(entry.name) or entry.is_symlink():
            continue
        with contextlib.suppress(OSError):  # gone, or another user's
            if time.time() - entry.stat().st_mtime < older:
                continue
            if entry.is_dir():
                shutil.rmtree(entry.path)
            else:
                os.unlink(entry.path)


def _temporary(folder: Path) -> Path:
    return folder / f".quadexp-{secrets.token_hex(8)}.tmp"


def _bytes(content: str | bytes) -> bytes:
    return content.encode() if isinstance(content, str) else content


def _take_name(temporary: Path, path: Path, force: bool) -> None:
    if force:
        os.replace(temporary, path)
        return
    try:
        try:
            os.link(temporary, path)
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
            path.touch(exist_ok=False)
            os.replace(temporary, path)
    except FileExistsError:
        raise taken(path) from None
