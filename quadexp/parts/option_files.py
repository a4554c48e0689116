"""The files that options are made of: conf/, then those of installed plugins, then a user's own folder."""

from __future__ import annotations

import contextlib
import functools
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.messages import MOST_NAMED, ending_in
from quadexp.parts.former_options import FORMER, former_nodes
from quadexp.parts.part import TARGET, Part, part_class
from quadexp.parts.plain_data import read_mapping
from quadexp.parts.plugins import plugin_folders
from quadexp.parts.schema import PARTS, conf_folder
from quadexp.parts.settings import declared
from quadexp.parts.sheets import FOLDER, Entry, entries

LOOK = "look"  # key of an option that says how it is drawn; its part has no such key
_MODIFIERS = re.compile(r"^\s*(?:(?:override|optional)\s+)*")


def folders(extra: Path | None = None) -> list[Path]:
    """Folders of configuration files, in the order in which an option is looked for."""
    return [conf_folder(), *plugin_folders().values(), *([extra] if extra else [])]


def groups(extra: Path | None = None) -> dict[str, list[str]]:
    """Configuration groups and their options: a listing of the folders and of the sheets."""
    found: dict[str, set[str]] = {}
    for root in folders(extra):
        for name in entries(root):
            group, _, option = name.partition("/")
            found.setdefault(group, set()).add(option)
        for folder in sorted(root.iterdir()) if root.is_dir() else ():
            if folder.is_dir() and folder.name != FOLDER:
                files = (path for path in folder.glob("*.yaml") if path.is_file())
                found.setdefault(folder.name, set()).update(path.stem for path in files)
    return {group: sorted(options) for group, options in found.items() if options}


class OptionFiles:
    """folders: in the order in which a file is looked for. groups: the options of every group. entries: the options
    that stand in sheets, but for those that a folder before has as a file."""

    def __init__(self, extra: Path | None = None) -> None:
        self.folders = folders(extra)
        self.groups = groups(extra)
        self.entries: dict[str, Entry] = {}
        for place, folder in enumerate(self.folders):
            for name, entry in entries(folder).items():
                if not any((other / f"{name}.yaml").is_file() for other in self.folders[: place + 1]):
                    self.entries.setdefault(name, entry)

    def options(self, group: str) -> list[str]:
        """Names of a group's options."""
        return [name for name in self.groups.get(group, ()) if not name.startswith("_")]

    def find(self, name: str) -> Path | None:
        """The file of a name such as "config" or "plant/ideal"; None where there is none."""
        if name in self.entries:
            return self.entries[name].sheet
        return next((path for folder in self.folders if (path := folder / f"{name}.yaml").is_file()), None)

    def read(self, name: str) -> Mapping[str, Any]:
        """What an option states, which must be there; UsageError where its file is no YAML."""
        return {key: value for key, value in self._stated(name).items() if key != LOOK}

    def look(self, name: str) -> Mapping[str, Any]:
        """How an option is drawn: hue, marker, dash; empty where it does not say."""
        look = self._stated(name).get(LOOK) or {}
        return look if isinstance(look, Mapping) else {}

    def _stated(self, name: str) -> Mapping[str, Any]:
        if name in self.entries:
            return self.entries[name].content
        path = self.find(name)
        assert path is not None, name
        return read_mapping(path)

    def meaning(self, name: str) -> str:
        """What an option is, in words: of a sheet, or the comment at the head of its file."""
        path = self.find(name)
        if path is None or name in self.entries:
            return self.entries[name].meaning if path else ""
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        return " ".join(line.lstrip("# ") for line in lines if line.startswith("#") and "@package" not in line)

    def check(self, names: Iterable[str]) -> None:
        """Read all files that these names lead to by their `defaults`, before a library does: UsageError where one is
        more than data. Those of conf/ lead to others of conf/ alone."""
        waiting = list(names)
        seen: set[str] = set()
        while waiting:
            name = waiting.pop().removesuffix(".yaml")
            file = self.find(name)
            if file is None or name in seen or file.is_relative_to(self.folders[0]):
                continue
            seen.add(name)
            content = self.read(name)
            for option in _defaults(content):
                if "${" in option:
                    raise UsageError(f"{file}: defaults: {option}: an option is chosen by its name, not by a reference")
                if option.startswith("/schema/"):
                    _say_former(file, option)
                waiting += [option.lstrip("/"), f"{name.rpartition('/')[0]}/{option}".lstrip("/")]

    def chosen_by(self, name: str) -> dict[str, str]:
        """Group -> option that the defaults of a file choose."""
        chosen = [one for one in self.read(name).get("defaults", ()) if isinstance(one, Mapping)]
        pairs = [pair for one in chosen for pair in one.items()]
        return {str(key).removeprefix("override /"): str(value) for key, value in pairs}

    def part_of(self, group: str, option: str) -> type[Part] | None:
        """The class of an option's part; None where its file, and those that it extends, name none."""
        content = self.read(f"{group}/{option}")
        extended = [str(one) for one in content.get("defaults") or () if isinstance(one, str) and one != "_self_"]
        former = [found for other in extended if (found := re.fullmatch(r"/schema/(\w+)/(\w+)@_here_", other))]
        node = next((former_nodes().get((found[1], found[2]), {}) for found in former), {})
        if target := node.get(FORMER) or content.get(TARGET) or node.get(TARGET):
            return part_class(group, str(target))
        others = (self.part_of(group, other) for other in extended if self.find(f"{group}/{other}") is not None)
        return next((one for one in others if one is not None), None)

    def parts(self, group: str) -> dict[str, type[Part]]:
        """The classes of a group's parts, by option; one whose file is wrong is left out: who takes it is told."""
        found: dict[str, type[Part]] = {}
        for option in self.options(group):
            with contextlib.suppress(UsageError):
                if (one := self.part_of(group, option)) is not None:
                    found[option] = one
        return found

    def having(self, key: str) -> dict[str, list[str]]:
        """Dotted keys that are the given one or end in it -> the options, chosen or not, that have it."""
        found: dict[str, list[str]] = {}
        for group in PARTS:
            parts = self.parts(group)
            named = {f"{group}.{name}" for one in parts.values() for name in declared(one)}
            for name in ending_in(key, sorted(named)) + ([key] if key in named else []):
                local = name.removeprefix(f"{group}.")
                options = [f"{group}={option}" for option, one in parts.items() if local in declared(one)]
                found |= {name: options[:MOST_NAMED]} if options else {}
        return found


@functools.cache
def _say_former(file: Path, option: str) -> None:
    print(
        f"note: {file}: defaults: [{option}@_here_] is the former form of `{TARGET}: MODULE.CLASS` (docs/migrating.md)",
        file=sys.stderr,
    )


@functools.cache
def units(group: str) -> dict[str, str]:
    """Units of the keys of a group's parts, by name; "" for a number without one."""
    return {
        name: one.setting.unit for part in OptionFiles().parts(group).values() for name, one in declared(part).items()
    }


def _defaults(content: Mapping[str, Any]) -> Iterator[str]:
    """The options that a file's `defaults` name, such as "/vehicle/mine" and "base"."""
    for one in content.get("defaults") or ():
        for group, options in one.items() if isinstance(one, Mapping) else [("", one)]:
            for option in options if isinstance(options, list) else [options]:
                words = (_MODIFIERS.sub("", str(part)).partition("@")[0] for part in (group, option))
                yield "/".join(filter(None, words))
