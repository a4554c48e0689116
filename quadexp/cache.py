"""The folder for what can be made again: compiled functions, and composed options of the configuration."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from quadexp.errors import DEVICE, QuadexpError, WriteError


def cache_folder() -> Path:
    """Folder of what is kept between runs: $QUADEXP_CACHE, else the user's cache folder; created private (0700)."""
    chosen = os.environ.get("QUADEXP_CACHE")
    folder = Path(chosen).absolute() if chosen else _usual_folder()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise unusable(folder, error) from None
    found = folder.stat()
    if found.st_uid != os.getuid():
        raise QuadexpError(f"{folder}: belongs to another user, set QUADEXP_CACHE to a folder of your own")
    if found.st_mode & 0o022:
        raise QuadexpError(
            f"{folder}: others may write there, and what lies there is executed; chmod go-w it, or set QUADEXP_CACHE"
        )
    return folder


def _usual_folder() -> Path:
    """The user's cache folder; below the system's temporary one where there is no home, or none that takes files."""
    away = Path(tempfile.gettempdir()) / f"quadexp-{os.getuid()}"
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        folder = (Path(base).absolute() if base else Path.home() / ".cache") / "quadexp"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (RuntimeError, OSError):
        return away
    return folder if os.access(folder, os.W_OK | os.X_OK) else away


def unusable(folder: Path, error: OSError) -> QuadexpError:
    reason = error.strerror or error
    kind = WriteError if error.errno in DEVICE else QuadexpError
    return kind(
        f"{folder}: compiled functions cannot be kept there ({reason}); set QUADEXP_CACHE to one that takes files"
    )
