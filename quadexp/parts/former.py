"""Names that users type, as they are called for one release more -> names of today; each is said once in a process."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from functools import cache
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from typing import Any

from quadexp.messages import note
from quadexp.plugin import shipped_places

# Groups of the configuration, as plug-ins say. Hashes have the old names, so that stored cells keep their keys.
GROUPS = {old: group for group, words in shipped_places("groups").items() for old in words.split()[2:]}
MODULES = {
    "quadexp.control.instant": "quadexp.control.control_step",
    "quadexp.control.built": "quadexp.control.cached_function",
    "quadexp.parts.sensor_sheet": "quadexp.parts.sensor_spec",
    **shipped_places("modules"),
}
# Module -> names in it -> where they are.
NAMES = {
    "quadexp.parts.part": {"Given": "quadexp.models.build_context:BuildContext"},
    "quadexp.parts.sensor_spec": {"SensorSheet": "quadexp.parts.sensor_spec:SensorSpec"},
    "quadexp.control.part": {"Remedy": "quadexp.control.part:Compensation"},
    "quadexp.world.effect": {"Told": "quadexp.world.effect:Measured"},
}
ATTRIBUTES = {"controller": {"name": "residual_name"}}  # of what a user's part makes, by seam
_BROUGHT = re.compile(r"(?<= )(\w+)(?=[.=])")  # a setting behind an option


@cache
def said(old: str, new: str) -> str:
    """The new name; a note says once that there is one."""
    note(f"{old}: is called {new} now; the old name is removed in the next release")
    return new


def group_of(name: str) -> str:
    """The group of today."""
    return said(name, GROUPS[name]) if name in GROUPS else name


def setting(text: str) -> str:
    """KEY=VALUE with the group of today; also in what an option brings."""
    key, dot, rest = re.match(r"([^.=]*)([.=]?)(.*)", text, re.DOTALL).groups()  # type: ignore[union-attr]
    rest = _BROUGHT.sub(lambda match: group_of(match[1]), rest)
    return f"{group_of(key)}{dot}{rest}"


def now(record: dict[str, Any]) -> dict[str, Any]:
    """A stored configuration by the groups of today."""
    return {GROUPS.get(key, key): value for key, value in record.items()}


def hashed(record: dict[str, Any]) -> dict[str, Any]:
    """A configuration by the groups that hashes have."""
    former = {new: old for old, new in GROUPS.items()}
    return {former.get(key, key): value for key, value in record.items()}


def names_of(module: str) -> Callable[[str], Any]:
    """`__getattr__` of a module, for the names that it had."""

    def attribute(name: str) -> Any:
        place = NAMES[module].get(name)
        if place is None:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        home, _, new = place.partition(":")
        return getattr(importlib.import_module(home), said(name, new))

    return attribute


def find_spec(name: str) -> ModuleSpec | None:
    """Of a module that has another name now."""
    new = MODULES.get(name)
    return None if new is None else ModuleSpec(name, _Loader(importlib.import_module(said(name, new))))


class _Loader(Loader):
    def __init__(self, module: Any) -> None:
        self._module = module

    def create_module(self, spec: ModuleSpec) -> Any:
        """The module of today, which keeps what says where it is."""
        self._kept = self._module.__spec__, self._module.__name__, self._module.__loader__
        return self._module

    def exec_module(self, module: Any) -> None:
        """It has been executed already."""
        module.__spec__, module.__name__, module.__loader__ = self._kept
