"""Numbers, tables and figures from flights and results."""

from collections.abc import Hashable, Iterable
from typing import TypeVar

FORMATS = ("svg", "png")  # in which every figure of a folder is written
Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


def grouped(pairs: Iterable[tuple[Key, Value]]) -> dict[Key, list[Value]]:
    """Key -> its values, both in order of appearance."""
    groups: dict[Key, list[Value]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups
