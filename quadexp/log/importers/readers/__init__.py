"""One module a format, of its name. It declares

    ABOUT                        for the list of formats
    recognises(path, head)       how sure it is that the file is its own, by its first bytes (None: a folder): 0 to 2
    read(path, named)            its RawLog; named: the --log-format that was asked for

and nothing else lists it: a module that is here is a format.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Protocol

from quadexp.errors import DataError, UsageError
from quadexp.log.importers.raw import RawLog

HEAD = 4096  # bytes


class Reader(Protocol):
    ABOUT: str

    def recognises(self, path: Path, head: bytes | None) -> int: ...

    def read(self, path: Path, named: str) -> RawLog: ...


@cache
def readers() -> dict[str, Reader]:
    """Every format."""
    return {one.name: import_module(f"{__name__}.{one.name}") for one in iter_modules(__path__)}


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
    sure = {name: reader.recognises(path, head) for name, reader in readers().items()}
    best = max(sure, key=lambda name: sure[name])
    if not sure[best]:
        what = "neither text nor" if head is not None else "a folder, but none of"
        raise DataError(f"{path}: {what} {', '.join(f'{name} ({one.ABOUT})' for name, one in readers().items())}")
    return best
