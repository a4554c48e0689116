"""Python values as the overrides that the command line takes: KEY=VALUE."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any

from quadexp.errors import UsageError
from quadexp.parts.override import quoted
from quadexp.parts.schema import Config

Given = str | Mapping[str, Any]
TOP = {*(f.name for f in fields(Config)), "experiment"}
_PLAIN = re.compile(r"[\w./:+-]+", re.ASCII)  # text that needs no quotes


def overrides(
    given: Sequence[Given], keywords: Mapping[str, Any], group: str = "trajectory", *, lists: bool = False
) -> list[str]:
    """Every setting as KEY=VALUE, in order.

    given: texts KEY=VALUE as on the command line, and dictionaries {key: value}, where a key may be dotted and a value
    a dictionary of its own. keywords: the same; a name that is no key of the configuration belongs to `group`: speed=8
    is trajectory.speed=8. lists: a list is several values of a sweep, and a list inside it one value.
    Raises UsageError for what is neither.
    """
    made: list[str] = []
    for one in given:
        if isinstance(one, str):
            made.append(one)
        elif isinstance(one, Mapping):
            made += _pairs(one, "", lists)
        else:
            raise UsageError(f"{one!r}: settings are text KEY=VALUE, dictionaries or keywords")
    full = {name if name in TOP else f"{group}.{name}": value for name, value in keywords.items()}
    return [*made, *_pairs(full, "", lists)]


def _pairs(values: Mapping[str, Any], prefix: str, lists: bool) -> Iterator[str]:
    for name, value in values.items():
        if not isinstance(name, str):
            raise UsageError(f"{name!r}: keys are text, such as 'trajectory.speed'")
        key, value = f"{prefix}{name}", value.tolist() if hasattr(value, "tolist") else value
        if isinstance(value, Mapping):
            yield from _pairs(value, f"{key}.", lists)
        elif lists and isinstance(value, (list, tuple, range)):
            if not value:
                raise UsageError(f"{key}: an empty list leaves nothing to fly")
            yield f"{key}={','.join(_text(key, one) for one in value)}"
        else:
            yield f"{key}={_text(key, value)}"


def _text(key: str, value: Any) -> str:
    """One value in the grammar of overrides."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if value is None or isinstance(value, (bool, int, float)):
        return "null" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)
    if isinstance(value, (list, tuple, range)):
        return f"[{','.join(_text(key, one) for one in value)}]"
    if isinstance(value, (str, os.PathLike)):
        text = os.fspath(value)
        return text if _PLAIN.fullmatch(text) else quoted(text)
    raise UsageError(f"{key}: a {type(value).__name__} is no value: numbers, text, paths, lists and dictionaries are")
