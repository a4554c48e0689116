"""What there is to choose: groups, their options, the keys of an option, for `quadexp options` and the completion.

It is read from the files and the parts' classes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from quadexp.errors import UsageError
from quadexp.names import without
from quadexp.parts.models import GROUP, named_by
from quadexp.parts.options import Folders, OptionFiles, given_folders, groups
from quadexp.parts.schema import CHOSEN, CLASSES, Config
from quadexp.parts.settings import REQUIRED, Declared, declared, shown

Record = dict[str, str]


def listed(asked: str = "", conf: Folders = None) -> list[Record]:
    """Records that answer a question.

    asked: "" for all groups; GROUP for its options, their keys, and the keys that have its name; GROUP=OPTION for the
    keys of that option; any other word for the options, keys and meanings that contain it. conf: folders of the user's
    own. A key that stands in no group, and `evaluate`, is asked for as a group is.

    Raises UsageError where nothing does.
    """
    files = OptionFiles(given_folders(conf))
    for defined in files.definitions:
        files.note_covered(*defined.split("/"))
    group, _, option = asked.partition("=")
    if not asked:
        return [
            {"group": name, "options": " ".join(files.options(name))} for name in (*files.groups, *declared(Config))
        ]
    if option and group in files.groups:
        name = files.named(group, option)
        if name is None:
            raise UsageError(f"{asked}: {files.why_not(group, option)}")
        return _keys(files, group, name)
    keys = _all_keys(files)
    if group in (*files.groups, *declared(Config)):  # and what else is called like it
        its, others = (
            [part for part in keys if (part["key"].partition(".")[0] == group) == is_own] for is_own in (True, False)
        )
        others = [record for record in others if group in record["key"].partition(".")[2]]
        return _options(files, group) + its + others
    options = [record for name in files.groups for record in _options(files, name)]
    records = [record for record in options + keys if asked.lower() in " ".join(record.values()).lower()]
    if not records:
        raise UsageError(f"options {asked}: no group, option or key has this word")
    return records


def _options(files: OptionFiles, group: str) -> list[Record]:
    """The options of a group, with what the head of each file says."""
    return [
        {"option": f"{group}={name}", "meaning": files.meaning(group, name).partition(". ")[0].rstrip(".")}
        for name in files.options(group)
    ]


def _keys(files: OptionFiles, group: str, option: str) -> list[Record]:
    """The keys of an option with what it sets them to; of a preset or bundle what it sets."""
    part = files.part_of(group, option)
    stated = files.option(group, option)
    if part is None:
        sets = stated.chosen | {key: value for key, value in stated.values.items() if not key.startswith("_")}
        return [{"key": key, "value": shown(value), "allowed": "", "meaning": ""} for key, value in sets.items()]
    return [
        _key(f"{group}.{name}", key, stated.values.get(name, key.default))
        for name, key in declared(part).items()
        if key.setting.meaning and name != "name"
    ]


def _all_keys(files: OptionFiles) -> list[Record]:
    """Every key once, with the value that it has by default, else that of the first option that has it."""
    records = {name: _key(name, key, key.default) for name, key in _walk(Config)}
    for group in files.groups:
        for option in sorted(files.parts(group), key=lambda option: option != CHOSEN.get(group)):
            for record in _keys(files, group, option):
                records.setdefault(record["key"], record)
    return list(records.values())


def _key(name: str, key: Declared, value: Any) -> Record:
    words = _words(key)
    allowed = " ".join(words) if words else f"{key.setting.interval} {key.setting.unit}".strip()
    default = "..." if key.node else shown(value)
    if value == REQUIRED:
        default = ""
    return {"key": name, "value": default, "allowed": allowed, "meaning": key.setting.meaning}


def _words(key: Declared) -> tuple[str, ...]:
    """The only values that a key may have; () where these are not a few words."""
    return key.words or named_by(key)


# -------------------------------------------------------------------------------------------------------- completion
def key_words(group: str | None = None, conf: Folders = None) -> dict[str, list[str]]:
    """Every key that can be set, of whatever option, with its values where those are a few words. group: of one group
    alone; only the classes of its parts are imported. conf: folders of the user's own."""
    files = OptionFiles(given_folders(conf))
    of_groups = [name for name in CLASSES if group in (None, name)]
    every_key = [*_walk(Config)]
    every_key += [each for name in of_groups for part in files.parts(name).values() for each in _walk(part, f"{name}.")]
    keys: dict[str, dict[str, None]] = {}
    for name, key in every_key:
        words = _words(key) or (("true", "false") if key.type is bool else ())
        keys.setdefault(name, {}).update(dict.fromkeys(words))
    return {key: list(words) for key, words in sorted(keys.items())}


def _walk(node: type, prefix: str = "") -> Iterator[tuple[str, Declared]]:
    """The keys of a class and of the nodes below it, with what they hold."""
    for name, key in declared(node).items():
        if key.node is not None:
            yield from _walk(key.node, f"{prefix}{name}.")
        elif name not in ("options", "_target_"):
            yield f"{prefix}{name}", key


def candidates(words: list[str], incomplete: str, conf: Folders = None) -> list[str]:
    """What an override that is being typed can become. words: those before it. conf: folders of the user's own.

    Shells that split words at "=" want the value alone back.
    """
    options = without(groups(conf), (GROUP,))  # model=PATH is a checkpoint
    line = " ".join([*words[-2:], incomplete])
    values = key_words(next((name for name in options if f"{name}." in line), ""), conf) | options
    bare = False
    if not incomplete and words and words[-1] in values:
        key = words[-1]
        value = ""
        bare = True
    elif len(words) >= 2 and words[-1] == "=":
        key = words[-2]
        value = incomplete
        bare = True
    elif "=" in incomplete:
        key, _, value = incomplete.partition("=")
    else:
        names = [name for name in values if name.startswith(incomplete) and ("." in incomplete or "." not in name)]
        # A single key brings its values along, so that the shell adds no blank after "=".
        exact = [f"{names[0]}={value}" for value in values[names[0]]] if len(names) == 1 else []
        return exact or [f"{name}=" for name in names]
    before, comma, last = value.rpartition(",")
    prefix = ("" if bare else f"{key}=") + before + comma
    return [prefix + option for option in values.get(key, []) if option.startswith(last)]
