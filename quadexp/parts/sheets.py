"""A sheet: a file with several options, DIR/options/NAME.yaml; by group and option, what each one sets.

    controller:
      nominal_mpc_tuned: {of: nominal_mpc, position_weight: [28.5, 28.5, 28.5]}
    world:
      heavy: {meaning: 30 % more mass than believed, actuator: first_order, truth.mass: 1.3}

`of` names the option that it extends, `meaning` says in words what it is, `provenance` where its values come from; the
rest is what a file GROUP/OPTION.yaml would state. Of a bundle (world, remedies) a key that names a group chooses its
option, and GROUP.KEY sets a value. A part of a world whose values are set so is an option too: truth=heavy.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from quadexp.errors import UsageError
from quadexp.parts.plain_data import read_mapping
from quadexp.parts.schema import BUNDLES, CHOSEN, PARTS, PRESETS, WORLD

FOLDER = "options"  # of the sheets, in a folder of configuration
ABOUT = ("of", "meaning", "provenance")  # keys of an entry that set nothing


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
    options: dict[str, Entry] = {}
    groups = (*PARTS, *PRESETS, *BUNDLES)
    for group, stated in read_mapping(sheet).items():
        if group not in groups or not isinstance(stated, Mapping):
            raise UsageError(f"{sheet}: {group}: must be a group that holds options; groups are {', '.join(groups)}")
        for option, values in stated.items():
            if not isinstance(values, Mapping):
                raise UsageError(f"{sheet}: {group}: {option}: must hold keys and values")
            about = [values.get(word) for word in ABOUT]
            settings = {str(key): value for key, value in values.items() if key not in ABOUT}
            for name, content in _contents(group, str(option), settings, about[0]).items():
                options[name] = Entry(sheet, content, " ".join(str(about[1] or "").split()), about[2])
    return options


def _contents(group: str, option: str, values: dict[str, Any], extended: Any) -> dict[str, dict[str, Any]]:
    """Name -> content of the options that an entry stands for. extended: the option that it extends, or None."""
    defaults: list[Any] = [] if extended is None else [extended]
    if group not in BUNDLES:
        return {f"{group}/{option}": {"defaults": [*defaults, "_self_"], **values}}
    chosen = {key: value for key, value in values.items() if "." not in key}
    nodes: dict[str, dict[str, Any]] = {}
    for key in (key for key in values if key not in chosen):
        part, *parents, last = key.split(".")
        node = nodes.setdefault(part, {})
        for parent in parents:
            node = node.setdefault(parent, {})
        node[last] = values[key]
    contents: dict[str, dict[str, Any]] = {}
    for part in nodes.keys() & WORLD if group == "world" else ():
        contents |= _contents(part, option, {"name": option, **nodes.pop(part)}, chosen.get(part, CHOSEN[part]))
        chosen[part] = option
    overrides = [{f"override /{part}": chosen[part]} for part in chosen]
    return {**contents, f"{group}/{option}": {"defaults": [*defaults, *overrides, "_self_"], **nodes}}
