"""The files that options are made of: conf/, then those of installed plugins, then a user's own folder."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from quadexp.config.completion import folders, groups
from quadexp.config.plain_data import REFERENCE, REFERENCES, read_data
from quadexp.config.schema import SCHEMAS
from quadexp.config.settings import declared
from quadexp.errors import UsageError
from quadexp.messages import MOST_NAMED, ending_in

_MODIFIERS = re.compile(r"^\s*(?:(?:override|optional)\s+)*")


class OptionFiles:
    """folders: in the order in which a file is looked for. groups: the options of every group."""

    def __init__(self, extra: Path | None = None) -> None:
        self.folders = folders(extra)
        self.groups = groups(extra)

    def options(self, group: str) -> list[str]:
        """Names of a group's options."""
        return [name for name in self.groups.get(group, ()) if not name.startswith("_")]

    def find(self, name: str) -> Path | None:
        """The file of a name such as "config" or "plant/ideal"; None where there is none."""
        return next((path for folder in self.folders if (path := folder / f"{name}.yaml").is_file()), None)

    def read(self, name: str) -> Mapping[str, Any]:
        """What a file says, which must be there; UsageError where it is no YAML."""
        import yaml

        path = self.find(name)
        assert path is not None, name
        try:
            content = read_data(path) or {}
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise unreadable(path, error) from None
        if wrong := re.search(r"\$\{[^}]{,60}\}?", REFERENCE.sub("", str(content))):
            raise UsageError(f"{path}: {wrong[0]}: {REFERENCES}")
        if not isinstance(content, Mapping) or not isinstance(content.get("defaults") or [], list):
            raise UsageError(f"{path}: must be a mapping {{key: value}}, and `defaults` a list")
        return content

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
                waiting += [option.lstrip("/"), f"{name.rpartition('/')[0]}/{option}".lstrip("/")]

    def chosen_by(self, name: str) -> dict[str, str]:
        """Group -> option that the defaults of a file choose."""
        chosen = [one for one in self.read(name).get("defaults", ()) if isinstance(one, Mapping)]
        pairs = [pair for one in chosen for pair in one.items()]
        return {str(key).removeprefix("override /"): str(value) for key, value in pairs}

    def having(self, key: str) -> dict[str, list[str]]:
        """Dotted keys that are the given one or end in it -> the options, chosen or not, that have it."""
        found: dict[str, list[str]] = {}
        for group, schemas in SCHEMAS.items():
            named = {f"{group}.{name}" for schema in schemas.values() for name in declared(schema)}
            for name in ending_in(key, sorted(named)) + ([key] if key in named else []):
                kinds = {kind for kind, schema in schemas.items() if name.removeprefix(f"{group}.") in declared(schema)}
                options = [f"{group}={one}" for one in self.options(group) if self._schema_of(group, one) in kinds]
                found |= {name: options[:MOST_NAMED]} if options else {}
        return found

    def _schema_of(self, group: str, option: str) -> str:
        """The schema that an option's file names, "" where it names none itself."""
        file = self.find(f"{group}/{option}")
        text = file.read_text(encoding="utf-8", errors="replace") if file else ""
        named = re.search(rf"/schema/{group}/(\w+)@", text)
        return named[1] if named else ""


def unreadable(path: Path, error: Exception) -> UsageError:
    """What is wrong with a file of YAML, in one line that names it."""
    mark = getattr(error, "problem_mark", None)
    place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
    reason = getattr(error, "problem", None) or str(error).splitlines()[0]
    return UsageError(f"{path}{place}: not valid YAML: {reason}")


def _defaults(content: Mapping[str, Any]) -> Iterator[str]:
    """The options that a file's `defaults` name, such as "/vehicle/mine" and "base"."""
    for one in content.get("defaults") or ():
        for group, options in one.items() if isinstance(one, Mapping) else [("", one)]:
            for option in options if isinstance(options, list) else [options]:
                words = (_MODIFIERS.sub("", str(part)).partition("@")[0] for part in (group, option))
                yield "/".join(filter(None, words))
