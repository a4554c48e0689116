"""The files that options are made of: conf/, then those of installed plugins, then a user's own folder."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from quadexp.config.completion import folders, groups
from quadexp.config.schema import SCHEMAS
from quadexp.config.settings import declared
from quadexp.errors import UsageError
from quadexp.messages import MOST_NAMED, ending_in


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
            return yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise self.unreadable(error) from None

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

    def unreadable(self, error: Exception) -> UsageError:
        """What is wrong with a file, in one line that names it."""
        mark = getattr(error, "problem_mark", None)
        file = mark.name if mark else getattr(error, "name", None) or self._undecodable()
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        reason = getattr(error, "problem", None) or str(error).splitlines()[0]
        return UsageError(f"{file}{place}: not valid YAML: {reason}")

    def _undecodable(self) -> str:
        for file in (path for folder in self.folders for path in sorted(folder.rglob("*.yaml"))):
            try:
                file.read_text(encoding="utf-8")
            except UnicodeDecodeError:
                return str(file)
        return "a file of the configuration"
