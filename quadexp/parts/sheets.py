"""A sheet: a file with several options, DIR/options/NAME.yaml; by group and option, what each one sets.

    controller:
      nominal_mpc_tuned: {of: nominal_mpc, position_weight: [28.5, 28.5, 28.5]}
    world:
      heavy: {meaning: 30 % more mass than believed, actuator: first_order, truth.mass: 1.3}

`of` names the option that it extends, `meaning` says in words what it is, `provenance` where its values come from; the
rest is what a file GROUP/OPTION.yaml would state. Of a bundle (world, remedies) a key that names a group chooses its
option, and GROUP.KEY sets a value. A part of the world whose values are set so is called as the option: truth=heavy.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from quadexp.errors import UsageError
from quadexp.parts.plain_data import read_mapping
from quadexp.parts.schema import BUNDLES, PARTS, PRESETS, WORLD

FOLDER = "options"  # of the sheets, in a folder of configuration


class Entry(NamedTuple):
    """An option of a sheet. content: what a file of its own would state, with `defaults`."""

    sheet: Path
    content: dict[str, Any]
    meaning: str
    provenance: dict[str, Any] | None


def entries(folder: Path) -> dict[str, Entry]:
    """Name, such as "world/heavy" -> option, of all sheets in a folder of configuration.

    Raises UsageError where a sheet is not of the form above, or two state the same option.
    """
    options: dict[str, Entry] = {}
    for sheet in sorted((folder / FOLDER).glob("*.yaml")):
        state = sheet.stat()
        for name, entry in _read(sheet, state.st_mtime_ns, state.st_size).items():
            if name in options:
                raise UsageError(f"{sheet}: {name}: stands in {options[name].sheet.name} too")
            options[name] = entry
    return options


@functools.cache
def _read(sheet: Path, modified: int, size: int) -> dict[str, Entry]:
    options = {}
    allowed = ", ".join([*PARTS, *PRESETS, *BUNDLES])
    for group, stated in read_mapping(sheet).items():
        if group not in (*PARTS, *PRESETS, *BUNDLES) or not isinstance(stated, Mapping):
            raise UsageError(f"{sheet}: {group}: must be a group that holds options; groups are {allowed}")
        for option, values in stated.items():
            if not isinstance(values, Mapping):
                raise UsageError(f"{sheet}: {group}: {option}: must hold keys and values")
            options[f"{group}/{option}"] = _entry(sheet, str(group), str(option), dict(values))
    return options


def _entry(sheet: Path, group: str, option: str, values: dict[str, Any]) -> Entry:
    extended, meaning, provenance = (values.pop(word, None) for word in ("of", "meaning", "provenance"))
    defaults: list[Any] = [] if extended is None else [extended]
    content: dict[str, Any] = {}
    for key, value in values.items():
        part, dot, rest = str(key).partition(".")
        if group not in BUNDLES:
            content[key] = value
        elif not dot:
            defaults.append({f"override /{part}": value})
        else:
            node = content.setdefault(part, {"name": option} if part in WORLD and group == "world" else {})
            *parents, last = rest.split(".")
            for parent in parents:
                node = node.setdefault(parent, {})
            node[last] = value
    content["defaults"] = [*defaults, "_self_"]
    return Entry(sheet, content, " ".join(str(meaning or "").split()), provenance)
