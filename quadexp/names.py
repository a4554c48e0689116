"""Names and the file names made from them.

A name of a part (vehicle, trajectory, controller, world and so on) is one printable line, so that it is one line in
every table, figure and message. `check_names` holds that where names are read from files, settings.py where they are
configured. A file name is made from any text by `file_name` alone, and is always one component of a path.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Container, Iterable, Mapping
from typing import Any, TypeVar

from quadexp.errors import DataError
from quadexp.plugin import shipped_places

T = TypeVar("T")
V = TypeVar("V")
LONGEST = 500  # characters of a name
NAMED = ("vehicle", "plant", "trajectory", "controller", "world")  # columns of a result row that hold names
_FILE_BYTES = 120  # of a file name before a suffix; file systems take 255
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)  # devices on Windows
# Of models, as they are called for one release more -> kind (parts/models.py). An option of such a group, but for
# `default`, is GROUP_OPTION of the group `model`.
SPELLINGS = shipped_places("spellings")


def distinct(values: Iterable[T]) -> list[T]:
    """The different ones, in the order in which they come first."""
    return list(dict.fromkeys(values))


def named(names: Iterable[T], values: Iterable[V]) -> dict[T, V]:
    """Name -> value, in order; there are as many of both."""
    return dict(zip(names, values, strict=True))


def without(values: Mapping[T, V], names: Container[T]) -> dict[T, V]:
    """The values but for those of some names."""
    return {name: value for name, value in values.items() if name not in names}


def sha256_of(content: str | bytes) -> str:
    """64 hex digits; of a text those of its UTF-8."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()


def is_name(text: str) -> bool:
    """Whether a text is one printable line, without blanks at its ends."""
    return 0 < len(text) <= LONGEST and text.isprintable() and text == text.strip()


def file_name(name: str) -> str:
    """The file name (without suffix) of any text: itself where it is one component of letters, digits, blanks and
    `_.,+=@-`; else with `_` for other signs, cut, and a hash of the text behind it, so that different texts differ."""
    kept = re.sub(r"[^\w.,+=@ -]", "_", name).strip(" .").lstrip("-").encode()[:_FILE_BYTES].decode(errors="ignore")
    if kept == name and kept and not _RESERVED.fullmatch(kept):
        return name
    return f"{kept}_{sha256_of(name.encode(errors='backslashreplace'))[:8]}"


def check_names(record: Mapping[str, Any], where: str) -> None:
    """Raise DataError where the record of a file, or a result row, holds a name that is none; "" is a missing one."""
    for part in (record, record.get("config"), record.get("row")):
        for key, value in part.items() if isinstance(part, Mapping) else ():
            name = value if key in NAMED else ""
            if isinstance(value, Mapping):
                name = value.get("name", "")
            if name and not (isinstance(name, str) and is_name(name)):
                raise DataError(f"{where}: the name of its {key} is not one printable line ({str(name)[:60]!r})")
