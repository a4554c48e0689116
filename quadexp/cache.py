"""The private folder for what can be made again: compiled functions, which are executed, and composed options.

Only a folder is used that belongs to this user, that nobody else may write to, and that nobody else may put another one
in the place of: each folder above it belongs to this user or to the owner of the root, and others may not write there,
unless it is sticky as /tmp is. Below a folder of this user that others may not enter, nothing needs to be looked at.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import stat
import tempfile
import time
from pathlib import Path

from quadexp.errors import DEVICE, QuadexpError, WriteError
from quadexp.writer import ABANDONED, clean

BOUND = 1_000_000_000  # bytes of all libraries
_LIBRARY = re.compile(r"\w+_[0-9a-f]{24}\.s?o")  # or what is compiled for several of them
_OTHERS = re.compile(r"\w+_[0-9a-f]{24}\.sha256|[0-9a-f]{24}\.lock|[0-9a-f]{40}\.json")


def cache_folder() -> Path:
    """Folder of what is kept between runs, made private (0700): $QUADEXP_CACHE, else the user's cache folder, else,
    where that takes no files or is open to others, one in the system's temporary folder. Raises QuadexpError."""
    chosen = os.environ.get("QUADEXP_CACHE")
    base = os.environ.get("XDG_CACHE_HOME")
    if not chosen:
        with contextlib.suppress(RuntimeError, QuadexpError):
            folder = _checked((Path(base) if base else Path.home() / ".cache") / "quadexp")
            if os.access(folder, os.W_OK | os.X_OK):
                return folder
    return _checked(Path(chosen or Path(tempfile.gettempdir()) / f"quadexp-{os.getuid()}"))


def _checked(path: Path) -> Path:
    """The folder, which is made where it is not there. Raises QuadexpError where others can get at it."""
    path = Path(os.path.realpath(path))
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        root = os.stat("/").st_uid
        closed = False
        for part in [*reversed(path.parents), path]:
            status = part.stat()
            last = part == path
            is_ours = status.st_uid == os.getuid()
            if not is_ours and (last or not (closed or status.st_uid == root)):
                raise QuadexpError(f"{part}: belongs to another user, set QUADEXP_CACHE to a folder of your own")
            if status.st_mode & 0o022 and (last or not (closed or status.st_mode & stat.S_ISVTX)):
                where = "there" if last else f"below, in {path},"
                raise QuadexpError(
                    f"{part}: others may write there, and what lies {where} is executed; chmod go-w it, or set"
                    " QUADEXP_CACHE"
                )
            closed |= is_ours and not status.st_mode & 0o011
    except OSError as error:
        raise unusable(path, error) from None
    return path


def libraries(folder: Path) -> dict[Path, os.stat_result]:
    """The libraries and what is known of them, the one first that was not used for longest (its time of change)."""
    entries = {}
    for entry in os.scandir(folder):
        with contextlib.suppress(OSError):  # removed by another process
            if _LIBRARY.fullmatch(entry.name):
                entries[Path(entry.path)] = entry.stat(follow_symlinks=False)
    return dict(sorted(entries.items(), key=lambda item: item[1].st_mtime))


def thin(folder: Path, newest: Path) -> None:
    """Keep the libraries below their bound, and remove what compilations left that were killed long ago."""
    entries = libraries(folder)
    total = sum(about.st_size for about in entries.values())
    for library, about in entries.items():
        if total > BOUND and library.name != newest.name:
            total -= about.st_size
            for path in (library, library.with_suffix(".sha256")):
                path.unlink(missing_ok=True)
    for scratch in folder.glob(".build-*"):
        with contextlib.suppress(OSError):
            if time.time() - scratch.stat().st_mtime > ABANDONED:
                shutil.rmtree(scratch, ignore_errors=True)


def clear(folder: Path) -> None:
    """Remove every file of the cache, known by its name; other files in the folder stay."""
    clean(folder, older=ABANDONED)
    for entry in os.scandir(folder):
        if _LIBRARY.fullmatch(entry.name) or _OTHERS.fullmatch(entry.name):
            Path(entry.path).unlink(missing_ok=True)


def unusable(folder: Path, error: OSError) -> QuadexpError:
    reason = error.strerror or error
    kind = WriteError if error.errno in DEVICE else QuadexpError
    return kind(
        f"{folder}: compiled functions cannot be kept there ({reason}); set QUADEXP_CACHE to one that takes files"
    )
