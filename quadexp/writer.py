"""The one writer: a file or a folder takes its name whole or not at all, and nobody else's link is followed.

The content goes into a new file of a random name in the folder that it will lie in (O_CREAT | O_EXCL | O_NOFOLLOW, the
folder held open) and is flushed to the disk. Then it takes its name: with `force` by rename(2), which replaces what is
there, a link itself and not what it leads to; without by link(2), which fails where the name is taken, so that of two
programs that write the same new file one is refused. Where a file system has no hard links, an empty file made with
O_EXCL takes the name first. A folder takes its name by rename(2), which replaces no folder that holds something.

A temporary is called .quadexp-<16 hex digits>.tmp and is locked (flock) as long as its writer lives. `clean` removes
those that no one holds any more, of this user, and nothing else.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

from quadexp.errors import UsageError, write_error

TEMPORARY = re.compile(r"\.quadexp-[0-9a-f]{16}\.tmp")
_NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)
FOLDER_FLAGS = getattr(os, "O_PATH", os.O_RDONLY) | os.O_DIRECTORY
_NEW = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW


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
        with opened(next(parent for parent in above if parent.exists())) as nearest:
            name, file = _new_file(nearest)
            file.close()
            os.unlink(name, dir_fd=nearest)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written there ({error.strerror}): choose another --out") from None
    except UnicodeEncodeError:
        name = os.fsencode(path).decode(errors="backslashreplace")
        raise UsageError(f"{name}: the name is not UTF-8: choose another --out") from None
    return path


def taken(path: Path) -> UsageError:
    return UsageError(f"{path}: exists already; pass --force to replace it, or choose another --out")


@contextlib.contextmanager
def written(
    path: str | Path, *, force: bool = True, durable: bool = True, inside: Path | None = None
) -> Iterator[BinaryIO]:
    """A file, open for reading and writing, that becomes `path` on leaving without an error.

    force: replace an existing file. durable: flush it to the disk first. inside: a folder above `path`, below which a
    link is refused. Raises UsageError where `path` is taken (without force), WriteError where it cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with opened(path.parent, inside) as folder:
            temporary, file = _new_file(folder)
            try:
                with file:
                    yield file
                    file.flush()
                    if durable:
                        os.fsync(file.fileno())
                    _take_name(folder, temporary, path, force)
            finally:
                with contextlib.suppress(OSError):
                    os.unlink(temporary, dir_fd=folder)
    except OSError as error:
        raise write_error(path, error) from error


def flush(folder: Path) -> None:
    """Have the disk hold what was written without `durable` on the file system of a folder, of this machine."""
    syncfs, fd = getattr(ctypes.CDLL(None), "syncfs", None), os.open(folder, os.O_RDONLY)
    try:
        if syncfs is None or syncfs(fd):
            os.sync()
    finally:
        os.close(fd)


def write_text(path: str | Path, text: str, *, force: bool = True, inside: Path | None = None) -> Path:
    """Write a text file, whole or not at all; see `written`."""
    with written(path, force=force, inside=inside) as file:
        file.write(text.encode())
    return Path(path)


def write_folder(path: Path, files: Mapping[str, str | bytes], *, force: bool = True) -> Path:
    """Write a folder of files, texts or bytes. A new one appears whole; in one that is there the files take their
    names once all are written, the last one first. Raises as `written` does."""
    try:
        if path.is_dir():
            with contextlib.ExitStack() as stack:
                for name, text in files.items():
                    stack.enter_context(written(path / name, force=force)).write(_bytes(text))
            return path
        path.parent.mkdir(parents=True, exist_ok=True)
        clean(path.parent)
        with opened(path.parent) as parent:
            os.mkdir(temporary := _new_name(), dir_fd=parent)
            try:
                _fill(parent, temporary, path.name, files)
            finally:
                shutil.rmtree(temporary, ignore_errors=True, dir_fd=parent)
    except OSError as error:
        raise taken(path) if error.errno in (errno.ENOTEMPTY, errno.EEXIST) else write_error(path, error) from error
    return path


@contextlib.contextmanager
def opened(folder: Path, inside: Path | None = None) -> Iterator[int]:
    """A folder held open. inside: a folder above it; what lies between the two is no link, else OSError."""
    fd = os.open(inside or folder, FOLDER_FLAGS)
    try:
        for name in folder.relative_to(inside).parts if inside else ():
            try:
                above, fd = fd, os.open(name, FOLDER_FLAGS | os.O_NOFOLLOW, dir_fd=fd)
            except NotADirectoryError:
                raise NotADirectoryError(errno.ENOTDIR, f"{name} is a link, or no folder") from None
            os.close(above)
        yield fd
    finally:
        os.close(fd)


def make_inside(root: Path, folder: Path) -> None:
    """Make a folder below `root`; WriteError where a link stands in its place, which could lead anywhere."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with opened(folder, root):
            pass
    except OSError as error:
        raise write_error(folder, error) from error


def remove(path: Path, inside: Path) -> None:
    """Remove a file below the folder `inside`, if it is there: a link itself, never by way of one."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError), opened(path.parent, inside) as folder:
        os.unlink(path.name, dir_fd=folder)


def clean(folder: Path) -> None:
    """Remove what killed writers left in a folder."""
    for entry in os.scandir(folder) if folder.is_dir() else ():
        if not TEMPORARY.fullmatch(entry.name):
            continue
        with contextlib.suppress(OSError):  # locked by its writer, gone, or a link
            is_folder = entry.is_dir(follow_symlinks=False)
            fd = os.open(entry.path, (os.O_RDONLY if is_folder else os.O_RDWR) | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(fd).st_uid == os.getuid():
                    (shutil.rmtree if is_folder else os.unlink)(entry.path)
            finally:
                os.close(fd)


def unfollowed(name: str, flags: int) -> int:
    """Opener of a lock file: refuses a link, and does not empty an existing file."""
    return os.open(name, (flags | os.O_NOFOLLOW) & ~os.O_TRUNC, 0o666)


def _new_name() -> str:
    return f".quadexp-{secrets.token_hex(8)}.tmp"


def _new_file(folder: int) -> tuple[str, BinaryIO]:
    """A new file and its name, locked against `clean`."""
    while True:
        name = _new_name()
        file = os.fdopen(os.open(name, _NEW, 0o666, dir_fd=folder), "w+b")
        with contextlib.suppress(OSError):  # a file system without locks, where `clean` removes nothing
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(file.fileno()).st_nlink:  # else it was taken for a killed writer's before it was locked
            return name, file
        file.close()


def _bytes(content: str | bytes) -> bytes:
    return content.encode() if isinstance(content, str) else content


def _fill(parent: int, temporary: str, name: str, files: Mapping[str, str | bytes]) -> None:
    """Write the files of a new folder, held open and locked, and let it take its name."""
    folder = os.open(temporary, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=parent)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        for inner, text in files.items():
            with os.fdopen(os.open(inner, _NEW, 0o666, dir_fd=folder), "wb") as file:
                file.write(_bytes(text))
                file.flush()
                os.fsync(file.fileno())
        os.rename(temporary, name, src_dir_fd=parent, dst_dir_fd=parent)
    finally:
        os.close(folder)


def _take_name(folder: int, temporary: str, path: Path, force: bool) -> None:
    try:
        if not force:
            try:
                os.link(temporary, path.name, src_dir_fd=folder, dst_dir_fd=folder, follow_symlinks=False)
                return
            except OSError as error:
                if error.errno not in _NO_LINKS:
                    raise
            os.close(os.open(path.name, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600, dir_fd=folder))
        os.rename(temporary, path.name, src_dir_fd=folder, dst_dir_fd=folder)
    except FileExistsError:
        raise taken(path) from None
