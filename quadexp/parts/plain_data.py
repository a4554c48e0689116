"""Configuration is data: a file is read whole and at once, its text is bounded, and it refers to keys alone.

A folder of configuration may come from anybody. So a file that is none (a pipe, a device) is not opened to be waited
for; aliases of YAML (&a, *a) stand for a bounded number of values, and nothing is nested without end; `${KEY}` names a
key of the configuration, and no resolver of a library (`${oc.env:HOME}`) is ever asked.
"""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError

MOST_BYTES = 1_000_000  # of a file
MOST_VALUES = 20_000  # of a file, every alias counted as what it stands for
DEEPEST = 40  # mappings and lists within each other
REFERENCE = re.compile(r"\$\{([A-Za-z_]\w*(?:\.\w+)*)\}")
REFERENCES = (
    "a reference is ${KEY} with a key of the configuration, such as ${seed} or ${trajectory.speed}, and none that leads"
    " back to itself"
)


def read_regular(path: Path) -> bytes:
    """The content of a regular file. Raises OSError for anything else, and UsageError for a large one."""
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(f"{path}: is no regular file")
        content = file.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise UsageError(f"{path}: is larger than {MOST_BYTES / 1e6:g} MB, which no file of settings is")
    return content


def read_data(path: Path) -> Any:
    """What a file of YAML says. UsageError where it is more than data; YAMLError, UnicodeDecodeError, OSError."""
    import yaml

    text = read_regular(path).decode("utf-8")
    values: list[tuple[str | None, int]] = [(None, 0)]  # anchor and number of values of all that is open
    sizes: dict[str, int] = {}
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    for event in yaml.parse(text, Loader=loader):
        place = f"{path}, line {event.start_mark.line + 1}"
        if isinstance(event, yaml.NodeEvent):
            anchor, size = event.anchor, 1
            if isinstance(event, yaml.AliasEvent):
                if anchor not in sizes:
                    raise UsageError(f"{place}: *{anchor} stands within what it stands for, or for nothing")
                size = sizes[anchor]
            elif isinstance(event, yaml.CollectionStartEvent):
                values.append((anchor, 0))
            elif anchor:
                sizes[anchor] = 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, size = values.pop()
            if anchor:
                sizes[anchor] = size
        else:
            continue
        values[-1] = (values[-1][0], values[-1][1] + size)
        if values[-1][1] > MOST_VALUES or len(values) > DEEPEST:
            raise UsageError(f"{place}: more than {MOST_VALUES} values with their aliases, or {DEEPEST} levels")
    return yaml.load(text, Loader=loader)


def read_mapping(path: Path) -> dict[str, Any]:
    """What a file of configuration states. UsageError where it is more than data, or no mapping."""
    import yaml

    try:
        content = read_data(path) or {}
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise unreadable(path, error) from None
    if wrong := re.search(r"\$\{[^}]{,60}\}?", REFERENCE.sub("", str(content))):
        raise UsageError(f"{path}: {wrong[0]}: {REFERENCES}")
    if not isinstance(content, dict) or not isinstance(content.get("defaults") or [], list):
        raise UsageError(f"{path}: must be a mapping {{key: value}}, and `defaults` a list")
    return content


def unreadable(path: Path, error: Exception) -> UsageError:
    """What is wrong with a file of YAML, in one line that names it."""
    mark = getattr(error, "problem_mark", None)
    place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
    reason = getattr(error, "problem", None) or str(error).splitlines()[0]
    return UsageError(f"{path}{place}: not valid YAML: {reason}")
