"""References, ${KEY}, of one setting to another."""

from __future__ import annotations

import re
from collections.abc import Callable, Container
from typing import Any

from quadexp.errors import UsageError

REFERENCE = re.compile(r"\$\{([A-Za-z_]\w*(?:\.\w+)*)\}")
REFERENCES = (
    "a reference is ${KEY} with a key of the configuration, such as ${seed} or ${trajectory.speed}, and none that leads"
    " back to itself"
)
MOST_STEPS = 16  # from reference to reference
MOST_LETTERS = 1000  # of what a reference stands for


class References:
    """What references stand for, each found once. nodes: names of what is at the root. content: of a node, by name."""

    def __init__(self, nodes: Container[str], content: Callable[[str], Any]) -> None:
        self._nodes = nodes
        self._content = content
        self._known: dict[str, Any] = {}

    def resolved(self, value: Any, at: str, way: tuple[str, ...] = ()) -> Any:
        """The value with its references replaced. at: its key. way: the keys that led here."""
        if isinstance(value, dict):
            return {key: self.resolved(item, f"{at}.{key}", way) for key, item in value.items()}
        if isinstance(value, list):
            return [self.resolved(item, at, way) for item in value]
        if not isinstance(value, str) or "${" not in value:
            return value
        if alone := REFERENCE.fullmatch(value):
            return self._referred(alone[1], at, way)
        if "${" in REFERENCE.sub("", value):
            raise UsageError(f"{at}: refers to what cannot be read; {REFERENCES}")
        return REFERENCE.sub(lambda match: str(self._referred(match[1], at, way)), value)

    def _referred(self, key: str, at: str, way: tuple[str, ...]) -> Any:
        """What a key stands for. at: the key that refers to it."""
        if key in way or len(way) > MOST_STEPS:
            raise UsageError(f"{at}: refers to what cannot be read; {REFERENCES}")
        if key not in self._known:
            name, *rest = key.split(".")
            value = self._content(name) if name in self._nodes else None
            for part in rest if name in self._nodes else [key]:
                if not isinstance(value, dict) or part not in value:
                    raise UsageError(f"{at}: refers to a name that does not exist; {REFERENCES}")
                value = value[part]
            self._known[key] = self.resolved(value, key, (*way, key))
        if len(str(self._known[key])) > MOST_LETTERS:
            raise UsageError(f"{at}: refers to {key}, which is too long to be referred to")
        return self._known[key]
