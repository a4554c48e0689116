"""Options: found in the folders of configuration, read as data, and joined with those that they extend.

The folders are a user's own, in the order in which they are given, then those of installed plugins, then conf/. Where
several have an option of one name, the first counts, and a note says what it covers. An option extends those of its own
folder and of the folders behind it, so an own `circle` that extends `circle` extends the one that it covers, and what
ships extends what ships. An option is a file GROUP/NAME.yaml:

    defaults: [nominal_mpc, _self_]       # an option extends others of its group
    defaults: [override /wind: gust]      # a bundle, or an experiment, chooses options of other groups

or an entry of an option file, options/SHEET.yaml, which holds several, by group and option:

    controller:
      nominal_mpc_tuned: {of: nominal_mpc, position_weight: [28.5, 28.5, 28.5]}
    world:
      heavy: {meaning: 30 % more mass than assumed, actuator: first_order, truth.mass: 1.3}

`of` names the option that it extends, `meaning` says in words what it is, `provenance` where its values come from; the
rest is what a file would state. `numbers: MODULE.FUNCTION NAME` takes values from FUNCTION(group, NAME), under what is
stated. Of a bundle (world, remedies) a key that names a group chooses its option, and GROUP.KEY sets a value. A part of
a world whose values are set so is an option too: truth=heavy.

An option of this program that needs a plug-in which is not there is not there either, see absent.py.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from quadexp.errors import UsageError
from quadexp.messages import MOST_NAMED, ending_in, note, suggestion
from quadexp.names import without
from quadexp.parts.absent import absent, chosen_group, lacking
from quadexp.parts.former import group_of
from quadexp.parts.part import TARGET, Part, imported, part_class
from quadexp.parts.schema import BUNDLES, CHOSEN, CLASSES, PRESETS, WORLD, conf_folder, lacks_plugin
from quadexp.parts.settings import declared
from quadexp.parts.user_modules import import_from, plugin_folders
from quadexp.parts.yaml_files import Spelled, read_mapping
from quadexp.provenance import content_hash

OPTION_FILES = "options"  # folder of the option files, in a folder of configuration
NOTHING = "nothing"  # the option file of the options that do nothing, for each of which `none` stands
ABOUT = ("of", "meaning", "provenance")  # keys of an entry that set nothing
LOOK = "look"  # key of an option that says how it is drawn; its part has no such key
NUMBERS = "numbers"  # key of an option that takes values from a function
CITE = "cite"  # key of an option that names its papers: of conf/references.bib, of a folder's own, or in words
GLOBAL = ("experiment", *BUNDLES)  # groups whose options set values of the whole configuration
Place = str | os.PathLike[str]
Folders = Place | Iterable[Place] | None  # of a user's own, as given with --conf; the first comes first


class Entry(NamedTuple):
    """An option of an option file. content: what a file of its own would state, with `defaults`."""

    option_file: Path
    content: dict[str, Any]
    meaning: str
    provenance: dict[str, Any] | None


@dataclass(frozen=True, eq=False)
class Definition:
    """Where an option is stated. place: of its folder among the folders. path: its file, or the option file of the
    entry."""

    place: int
    path: Path
    entry: Entry | None

    @property
    def content(self) -> dict[str, Any]:
        """What is stated, with `defaults`."""
        return read_mapping(self.path) if self.entry is None else self.entry.content


class Option(NamedTuple):
    """An option with those that it extends. values: what they set. chosen: options of other groups, by group."""

    values: dict[str, Any]
    chosen: dict[str, str]


def given_folders(extra: Folders) -> tuple[Path, ...]:
    """The folders given with --conf, each once, whose modules can then be imported.

    UsageError where one is no folder, or has no option in it."""
    folders = _resolved(extra)
    for folder, folder_name in folders.items():
        if not folder.is_dir():
            raise UsageError(f"--conf {folder_name}: {'is a file, not a' if folder.is_file() else 'no such'} folder")
        if {path.parent.name for path in folder.glob("*/*.yaml")}.isdisjoint(
            {*CHOSEN, *CLASSES, "experiment", OPTION_FILES}
        ):
            raise UsageError(f"--conf {folder_name}: has no options, such as a file controller/NAME.yaml in it")
    if folders:
        import_from(*folders)
    return tuple(folders)


def _resolved(extra: Folders) -> dict[Path, Place]:
    """The folders, each once, with what each is called."""
    stated = [extra] if isinstance(extra, (str, os.PathLike)) else extra or ()
    return {Path(folder).resolve(): folder for folder in stated}


def groups(extra: Folders = None) -> dict[str, list[str]]:
    """Configuration groups and their options: a listing of the folders and of the option files."""
    return OptionFiles(extra).groups


class OptionFiles:
    """folders: in the order in which an option is looked for. definitions: of every option, such as "plant/ideal", the
    one that counts first. groups: the options of every group. entries: the options that stand in option files."""

    def __init__(self, extra: Folders = None) -> None:
        self.folders = [*_resolved([*_resolved(extra), *plugin_folders().values(), conf_folder()])]
        self.definitions: dict[str, list[Definition]] = {}
        *_, shipped = self.folders
        for place, folder in enumerate(self.folders):
            out = absent_options() if folder == shipped else {}
            for name, definition in _stated(place, folder):
                if name not in out:
                    self.definitions.setdefault(name, []).append(definition)
        self.entries = {name: first.entry for name, (first, *_) in self.definitions.items() if first.entry}
        self.groups: dict[str, list[str]] = {}
        for name in sorted(self.definitions):
            group, _, option = name.partition("/")
            self.groups.setdefault(group, []).append(option)
        self._options: dict[tuple[str, str], Option] = {}

    def options(self, group: str) -> list[str]:
        """Names of a group's options."""
        return [name for name in self.groups.get(group, ()) if not name.startswith("_")]

    def named(self, group: str, option: Any) -> str | None:
        """The option of this name; None where there is none. `none` is the one that does nothing."""
        options = self.options(group)
        option = str(option)
        if option in options or option != "none":
            return option if option in options else None
        stated = ((name, each.path) for name in options for each in self.definitions[f"{group}/{name}"])
        return next((name for name, path in stated if path.match(f"{OPTION_FILES}/{NOTHING}.yaml")), None)

    def why_not(self, group: str, option: Any) -> str:
        """Why there is no such option."""
        unknown = f"no such {group}{suggestion(str(option), self.options(group))}"
        return absent_options().get(f"{group}/{option}", unknown)

    def note_covered(self, group: str, option: str) -> None:
        """Say once where an option comes before another one of its name."""
        first, *others = self.definitions[f"{group}/{option}"]
        if others:
            shipped = others[0].place == len(self.folders) - 1
            covered = "the shipped option of this name" if shipped else others[0].path
            note(f"{group}={option}: {first.path} covers {covered}")

    def meaning(self, group: str, option: str) -> str:
        """What an option is, in words: as its option file says, or the comment at the head of its file."""
        first = self.definitions[f"{group}/{option}"][0]
        if first.entry:
            return first.entry.meaning
        lines = first.path.read_text(encoding="utf-8", errors="replace").splitlines()
        return " ".join(line.lstrip("# ") for line in lines if line.startswith("#") and "@package" not in line)

    def look(self, group: str, option: str) -> Mapping[str, Any]:
        """How an option is drawn: hue, marker, dash; empty where it does not say."""
        look = self.definitions[f"{group}/{option}"][0].content.get(LOOK)
        return look if isinstance(look, Mapping) else {}

    def cited(self, group: str, option: str) -> list[str]:
        """The papers of an option, or else of those that it extends."""
        stated = self.definitions[f"{group}/{option}"][0].content
        papers = stated.get(CITE) or []
        if papers:
            return [str(paper) for paper in ([papers] if isinstance(papers, str) else papers)]
        above = [str(name) for name in stated.get("defaults") or [] if f"{group}/{name}" in self.definitions]
        return [paper for name in above if name != option for paper in self.cited(group, name)]

    def option(self, group: str, name: str) -> Option:
        """An option with those that it extends, read once; do not change it."""
        if (group, name) not in self._options:
            self._options[group, name] = self._read_option(group, name, ())
        return self._options[group, name]

    def read(self, group: str, name: str, extending: tuple[Definition, ...] = ()) -> tuple[Definition, dict[str, Any]]:
        """An option, or what the last of `extending` extends, see the head of this module; and what it says, but for
        how it is drawn. UsageError where there is none, or it is none of settings."""
        known = self.definitions.get(f"{group}/{name}", [])
        if not known:
            raise UsageError(f"{group}={name}: {self.why_not(group, name)}")
        usable = [each for each in known if each not in extending]
        if not usable:
            raise UsageError(f"{extending[-1].path}: defaults: {group}={name} extends itself")
        definition = min(usable, key=lambda each: bool(extending) and each.place < extending[-1].place)
        content = without(definition.content, (LOOK, CITE, NUMBERS))
        place, _, of = str(definition.content.get(NUMBERS, "")).partition(" ")
        numbers = imported(f"{group}={name}: {NUMBERS}: {place}", place)(group, of) if place else {}
        return definition, numbers | content

    def _read_option(self, group: str, name: str, extending: tuple[Definition, ...]) -> Option:
        """extending: the options that led here."""
        definition, content = self.read(group, name, extending)
        path = definition.path
        stated = {group_of(str(key)): value for key, value in content.items() if key != "defaults"}
        defaults = content.get("defaults") or []
        values: dict[str, Any] = {}
        chosen = dict[str, str]()
        inherited = dict[str, str]()
        for entry in [*defaults, *([] if "_self_" in defaults else ["_self_"])]:
            text = str(entry)
            if "${" in text:
                raise UsageError(f"{path}: defaults: {text}: an option is chosen by its name, not by a reference")
            if text == "_self_":
                merge(values, stated)
            elif isinstance(entry, Mapping) and group in GLOBAL:
                chosen |= self._choices(path, entry)
            elif not isinstance(entry, (str, Spelled)):
                raise UsageError(f"{path}: defaults: {text}: an option extends others of its group, by their names")
            else:
                extended = self._read_option(group, text.removesuffix(".yaml"), (*extending, definition))
                merge(values, extended.values)
                inherited |= extended.chosen
        return Option(values, inherited | chosen)

    def _choices(self, path: Path, entry: Mapping[Any, Any]) -> dict[str, str]:
        """Options that an entry of `defaults` chooses, such as `override /wind: gust`."""
        choices = {}
        for key, option in entry.items():
            group = chosen_group(key)
            if lacks_plugin(group):
                if option == "none":
                    continue
                raise UsageError(f"{path}: {group}={option}: {lacking(group)}")
            if group not in CHOSEN:
                raise UsageError(f"{path}: defaults: {key}: must be `override /GROUP`, of {', '.join(CHOSEN)}")
            name = self.named(group, option)
            if name is None:
                raise UsageError(f"{path}: defaults: {key}: {option}: {self.why_not(group, option)}")
            choices[group] = name
        return choices

    def part_of(self, group: str, option: str) -> type[Part] | None:
        """The class of an option's part; None where its file, and those that it extends, name none."""
        target = self.option(group, option).values.get(TARGET)
        return part_class(group, str(target)) if target and group in CLASSES else None

    def parts(self, group: str) -> dict[str, type[Part]]:
        """The classes of a group's parts, by option; one whose file is wrong is left out: who takes it is given."""
        parts: dict[str, type[Part]] = {}
        for option in self.options(group):
            with contextlib.suppress(UsageError):
                if part := self.part_of(group, option):
                    parts[option] = part
        return parts

    def having(self, key: str) -> dict[str, list[str]]:
        """Dotted keys that are the given one or end in it -> the options, chosen or not, that have it."""
        having: dict[str, list[str]] = {}
        for group in CLASSES:
            named: dict[str, list[str]] = {}
            for option, part in self.parts(group).items():
                for name in declared(part):
                    named.setdefault(f"{group}.{name}", []).append(f"{group}={option}")
            for name in ending_in(key, sorted(named)) + ([key] if key in named else []):
                having[name] = named[name][:MOST_NAMED]
        return having


def merge(values: dict[str, Any], over: Mapping[str, Any]) -> None:
    """Set values over others, key by key where both are mappings."""
    for key, value in over.items():
        if isinstance(value, Mapping) and isinstance(values.get(key), dict):
            merge(values[key], value)
        else:
            values[key] = copy.deepcopy(value)


def nested(key: str, value: Any) -> dict[str, Any]:
    """{A: {B: value}} of a dotted key A.B."""
    return functools.reduce(lambda inner, part: {part: inner}, reversed(key.split(".")), value)


@functools.cache
def units(group: str) -> dict[str, str]:
    """Units of the keys of a group's parts, by name; "" for a number without one."""
    parts = OptionFiles().parts(group).values()
    return {name: setting.setting.unit for part in parts for name, setting in declared(part).items()}


@functools.cache
def absent_options() -> dict[str, str]:
    """Option of this program, such as "trajectory/circle" -> why it is not there."""
    return absent(dict(_stated(0, conf_folder())))


# ------------------------------------------------------------------------------------------------------------ sheets
def _stated(place: int, folder: Path) -> Iterator[tuple[str, Definition]]:
    """The options of a folder of configuration, such as "plant/ideal", without groups whose plug-in is not there."""
    files = (path for path in folder.glob("*/*.yaml") if path.is_file() and path.parent.name != OPTION_FILES)
    stated = [(f"{group_of(path.parent.name)}/{path.stem}", Definition(place, path, None)) for path in files]
    stated += [(name, Definition(place, entry.option_file, entry)) for name, entry in entries(folder).items()]
    return ((name, definition) for name, definition in stated if not lacks_plugin(name.partition("/")[0]))


def entries(folder: Path) -> dict[str, Entry]:
    """Name, such as "world/heavy" -> option, of all option files in a folder of configuration.

    Raises UsageError where an option file is not of the form above, or two state the same option.
    """
    options: dict[str, Entry] = {}
    for option_file in sorted((folder / OPTION_FILES).glob("*.yaml")):
        for name, entry in _entries_of(option_file, content_hash(option_file)).items():
            if name in options:
                raise UsageError(f"{option_file}: {name}: stands in {options[name].option_file.name} too")
            options[name] = entry
    return options


@functools.cache
def _entries_of(option_file: Path, hashed: str) -> dict[str, Entry]:
    options: dict[str, Entry] = {}
    groups = (*CLASSES, *PRESETS, *BUNDLES)
    for group, stated in read_mapping(option_file).items():
        if lacks_plugin(group):
            continue
        if group not in groups or not isinstance(stated, Mapping):
            raise UsageError(
                f"{option_file}: {group}: must be a group that holds options; groups are {', '.join(groups)}"
            )
        for option, values in stated.items():
            if not isinstance(values, Mapping):
                raise UsageError(f"{option_file}: {group}: {option}: must hold keys and values")
            extended, meaning, provenance = (values.get(word) for word in ABOUT)
            settings = {str(key): value for key, value in values.items() if key not in ABOUT}
            for name, content in _contents(group, str(option), settings, extended).items():
                options[name] = Entry(option_file, content, " ".join(str(meaning or "").split()), provenance)
    return options


def _contents(group: str, option: str, values: dict[str, Any], extended: Any) -> dict[str, dict[str, Any]]:
    """Name -> content of the options that an entry stands for. extended: the option that it extends, or None."""
    defaults = [] if extended is None else [extended]
    if group not in BUNDLES:
        return {f"{group}/{option}": {"defaults": [*defaults, "_self_"], **values}}
    chosen = {key: value for key, value in values.items() if "." not in key}
    nodes: dict[str, Any] = {}
    for key in (key for key in values if key not in chosen):
        merge(nodes, nested(key, values[key]))
    contents: dict[str, dict[str, Any]] = {}
    for part in nodes.keys() & WORLD if group == "world" else ():
        contents |= _contents(part, option, {"name": option, **nodes.pop(part)}, chosen.get(part, CHOSEN[part]))
        chosen[part] = option
    overrides = [{f"override /{part}": chosen[part]} for part in chosen]
    return {**contents, f"{group}/{option}": {"defaults": [*defaults, *overrides, "_self_"], **nodes}}
