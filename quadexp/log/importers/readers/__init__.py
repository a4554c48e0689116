"""One module a format. It declares

    ABOUT                        for the list of formats
    recognises(path, head)       whether the file is its own, by its first bytes (None: a folder)
    read(path, named)            its RawLog; named: the --log-format that was asked for

and stands under its name in BRINGS, of quadexp/plugin.py or of a package from outside.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Protocol

from quadexp.errors import DataError, UsageError
from quadexp.log.importers.raw import RawLog
from quadexp.plugin import brought, places

HEAD = 4096  # bytes


class Reader(Protocol):
    ABOUT: str

    def recognises(self, path: Path, head: bytes | None) -> bool: ...

    def read(self, path: Path, named: str) -> RawLog: ...


@cache
def readers() -> dict[str, Reader]:
    """Every format, the most general last: to it any text is a table."""
    names = sorted(places("readers"), key=lambda name: name == "csv")
    found = {name: brought("readers", name) for name in names}
    for name, reader in found.items():
        lacking = [asked for asked in ("ABOUT", "recognises", "read") if not hasattr(reader, asked)]
        if lacking:
            raise UsageError(f"reader {name}: {places('readers')[name]} has no {', '.join(lacking)}")
    return found


def reader_of(path: Path) -> str:
    """The format that a file is in, by its content, not by its name.

    Raises UsageError where there is no such file, DataError where it is empty or in none of the formats.
    """
    head = None
    if not path.is_dir():
        try:
            with open(path, "rb") as file:
                head = file.read(HEAD)
        except FileNotFoundError:
            raise UsageError(f"{path}: no such file") from None
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror})") from None
        if not head:
            raise DataError(f"{path}: the file is empty")
    known = next((name for name, reader in readers().items() if reader.recognises(path, head)), None)
    if known is None:
        what = "neither text nor" if head is not None else "a folder, but none of"
        raise DataError(f"{path}: {what} {', '.join(f'{name} ({r.ABOUT})' for name, r in readers().items())}")
    return known
