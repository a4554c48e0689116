"""Files of configuration, read as data; they may come from anybody.

A file that is none (a pipe, a device) is not opened to be waited for; aliases of YAML (&a, *a) stand for a bounded
number of values, and nothing is nested without end; `${KEY}` names a key of the configuration, and no resolver of a
library (`${oc.env:HOME}`) is ever asked.
"""

from __future__ import annotations

import functools
import math
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.parts.references import REFERENCE, REFERENCES
from quadexp.parts.schema import conf_folder

MOST_BYTES = 1_000_000  # of a file
MOST_VALUES = 20_000  # of a file, every alias counted as what it stands for
DEEPEST = 40  # mappings and lists within each other


def read_mapping(path: Path) -> dict[str, Any]:
    """What a file of configuration states. UsageError where it is more than data, or no mapping."""
    import yaml

    try:
        content = read_data(path) or {}
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        reason = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise UsageError(f"{path}{place}: not valid YAML: {reason}") from None
    if wrong := re.search(r"\$\{[^}]{,60}\}?", REFERENCE.sub("", str(content))):
        raise UsageError(f"{path}: {wrong[0]}: {REFERENCES}")
    if not isinstance(content, dict) or not isinstance(content.get("defaults") or [], list):
        raise UsageError(f"{path}: must be a mapping {{key: value}}, and `defaults` a list")
    return content


def read_data(path: Path) -> Any:
    """What a file of YAML says. UsageError where it is more than data; YAMLError, UnicodeDecodeError, OSError."""
    import yaml

    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(f"{path}: is no regular file")
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise UsageError(f"{path}: is larger than {MOST_BYTES / 1e6:g} MB, which no file of settings is")
    text = content.decode("utf-8")
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    refusal = UsageError(f"{path}: more than {MOST_VALUES} values with their aliases, or {DEEPEST} levels")
    if not path.is_relative_to(conf_folder()):  # whose own files are what they are
        loader = _spelling(loader)
        level = 0
        for event in yaml.parse(text, Loader=loader):  # the loader itself would end in a crash
            level += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if level > DEEPEST:
                raise refusal
    data = yaml.load(text, Loader=loader)
    if any(count > MOST_VALUES or level > DEEPEST for count, level in enumerate(_levels(data))):
        raise refusal
    return data


class Spelled:
    """A number of a file, which as a text is what was written: 2024_01 or 1.10 may be meant as a name."""

    spelling = ""

    def __repr__(self) -> str:
        return self.spelling


class _Whole(Spelled, int):
    pass


class _Real(Spelled, float):
    pass


@functools.cache
def _spelling(plain: Any) -> Any:
    """A loader of YAML whose numbers keep their spelling; 12:30, `no` and dates are texts, as in YAML 1.2.

    A key that is there twice is refused: the first value would be dropped without a word."""
    from yaml.constructor import ConstructorError

    class Loader(plain):
        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            keys = [str(key.value) for key, _ in node.value]
            for place, (key, _) in enumerate(node.value):
                if keys[place] in keys[:place]:
                    raise ConstructorError(None, None, f"{key.value} is there twice", key.start_mark)
            return super().construct_mapping(node, deep)

    def number(loader: Any, node: Any) -> Any:
        if ":" in node.value:
            return node.value
        value = getattr(loader, f"construct_yaml_{node.tag.rpartition(':')[2]}")(node)
        if str(value) == node.value or not math.isfinite(value):
            return value
        number_value = (_Whole if isinstance(value, int) else _Real)(value)
        number_value.spelling = node.value
        return number_value

    def word(loader: Any, node: Any) -> Any:
        return {"true": True, "false": False}.get(node.value.lower(), node.value)

    for tag, constructor in (("int", number), ("float", number), ("bool", word), ("timestamp", word)):
        Loader.add_constructor(f"tag:yaml.org,2002:{tag}", constructor)
    return Loader


def _levels(value: Any, level: int = 0) -> Iterator[int]:
    """How deep each value lies, what aliases stand for too; without end where a value lies within itself."""
    yield level
    if isinstance(value, (dict, list)) and level <= DEEPEST:
        for item in value.values() if isinstance(value, dict) else value:
            yield from _levels(item, level + 1)
