"""What there is to choose: groups, their options, the keys of an option; read from the files and the parts' classes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.parts.option_files import OptionFiles
from quadexp.parts.settings import REQUIRED, Declared, declared, lists

Record = dict[str, str]


def listed(asked: str = "", conf: Path | None = None) -> list[Record]:
    """Records that answer a question.

    asked: "" for all groups; GROUP for its options, and the keys that have its name; GROUP=OPTION for the keys of that
    option; any other word for the options, keys and meanings that contain it.

    Raises UsageError where nothing does.
    """
    files = OptionFiles(conf)
    group, _, option = asked.partition("=")
    if not asked:
        return [{"group": name, "options": " ".join(files.options(name))} for name in files.groups]
    if option and group in files.groups:
        name = files.named(group, option)
        if name is None:
            raise UsageError(f"{asked}: no such {group}{suggestion(option, files.options(group))}")
        return keys(files, group, name)
    if group in files.groups:  # and what else is called like it
        return options(files, group) + [one for one in _all_keys(files) if group in one["key"].partition(".")[2]]
    records = [one for name in files.groups for one in options(files, name) if asked in one["option"]]
    records += [one for one in _all_keys(files) if asked in one["key"] or asked in one["meaning"]]
    if not records:
        raise UsageError(f"options {asked}: no group, option or key has this word")
    return records


def options(files: OptionFiles, group: str) -> list[Record]:
    """The options of a group, with what the head of each file says."""
    return [
        {"option": f"{group}={name}", "meaning": files.meaning(group, name).partition(". ")[0].rstrip(".")}
        for name in files.options(group)
    ]


def keys(files: OptionFiles, group: str, option: str) -> list[Record]:
    """The keys of an option with what it sets them to; of a preset or bundle what it sets."""
    part, read = files.part_of(group, option), files.option(group, option)
    if part is None:
        sets = read.chosen | {key: value for key, value in read.values.items() if not key.startswith("_")}
        return [{"key": key, "value": _text(value), "allowed": "", "meaning": ""} for key, value in sets.items()]
    return [
        _key(f"{group}.{name}", one, read.values.get(name, one.default))
        for name, one in declared(part).items()
        if one.setting.meaning and name != "name"
    ]


def _all_keys(files: OptionFiles) -> list[Record]:
    """Every key once, with the value of the first option that has it."""
    records: dict[str, Record] = {}
    for group in files.groups:
        for option in files.options(group) if files.parts(group) else ():
            for one in keys(files, group, option):
                records.setdefault(one["key"], one)
    return list(records.values())


def _key(name: str, one: Declared, value: Any) -> Record:
    unit, interval = one.setting.unit, one.setting.interval
    allowed = " ".join(one.words) if one.words else f"{interval} {unit}".strip()
    shown = "" if value == REQUIRED else "..." if one.node else _text(lists(value))
    return {"key": name, "value": shown, "allowed": allowed, "meaning": one.setting.meaning}


def _text(value: Any) -> str:
    return "null" if value is None else str(value).replace(" ", "") if not isinstance(value, str) else value
