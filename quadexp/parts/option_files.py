"""The files that options are made of: conf/, then those of installed plugins, then a user's own folder.

    defaults: [nominal_mpc, _self_]       # an option extends others of its group
    defaults: [override /wind: gust]      # a bundle, or an experiment, chooses options of other groups

Several options stand in one file, a sheet (sheets.py). What does nothing needs no file: see ABSENT.
"""

from __future__ import annotations

import contextlib
import copy
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from quadexp.errors import UsageError
from quadexp.messages import MOST_NAMED, ending_in
from quadexp.parts.former import FORMER_CLASSES, FORMER_TARGET, former_name
from quadexp.parts.part import TARGET, Part, part_class
from quadexp.parts.plain_data import read_mapping
from quadexp.parts.plugins import plugin_folders
from quadexp.parts.schema import BUNDLES, CHOSEN, PARTS, conf_folder
from quadexp.parts.settings import declared
from quadexp.parts.sheets import FOLDER, Entry, entries

NOTHING = "quadexp.parts.part.Nothing"
# The options that do nothing: group -> (its word, meaning, what it says). `none` stands for each of them.
ABSENT: dict[str, tuple[str, str, dict[str, Any]]] = {
    "truth": (
        "nominal",
        "The vehicle is the one that controllers believe in, but for what truth.mass, truth.inertia, ... say",
        # the name in tables where a factor is not 1; otherwise nothing is said
        {TARGET: "quadexp.world.true_vehicle.TrueVehicle", "name": "off_nominal"},
    ),
    "payload": ("none", "The vehicle carries nothing that controllers do not know of", {TARGET: NOTHING}),
    "wind": ("none", "Still air", {TARGET: NOTHING}),
    "external": ("none", "Nothing pushes or pulls from outside", {TARGET: NOTHING}),
    "link": ("ideal", "A command acts at once", {TARGET: NOTHING}),
    "actuator": (
        "ideal",
        "Rotors deliver what the airframe's own equations make of a command",
        {TARGET: "quadexp.world.actuator.Actuator"},
    ),
    "battery": ("none", "The voltage does not matter", {TARGET: NOTHING}),
    "health": ("none", "Every rotor is sound", {TARGET: "quadexp.world.rotor_loss.RotorLoss"}),
    "ground": ("none", "The ground is far away", {TARGET: NOTHING}),
    "estimator": (
        "none",
        "The controller is told the true state, with white noise and a delay where they are set",
        {TARGET: "quadexp.world.stated_estimate.StatedEstimate"},
    ),
    "world": ("clean", "No imperfection but the plant's own: the world of the published tables", {}),
    "motor": ("none", "The rotors' lag is as the controller's own file says", {}),
    "observer": ("none", "Nothing is estimated of disturbances", {TARGET: NOTHING}),
    "adaptive": ("none", "Nothing is added to the commands", {TARGET: NOTHING}),
    "inner": ("none", "Commands go to the rotors as they are", {TARGET: NOTHING}),
    "delay": ("none", "Measurements count as those of now", {TARGET: NOTHING}),
    "remedies": ("none", "A controller by itself", {}),
}
LOOK = "look"  # key of an option that says how it is drawn; its part has no such key
GLOBAL = ("experiment", *BUNDLES)  # groups whose options set values of the whole configuration


class Option(NamedTuple):
    """An option with those that it extends. values: what they set. chosen: options of other groups, by group."""

    values: dict[str, Any]
    chosen: dict[str, str]


def folders(extra: Path | None = None) -> list[Path]:
    """Folders of configuration files, in the order in which an option is looked for."""
    return [conf_folder(), *plugin_folders().values(), *([extra] if extra else [])]


def groups(extra: Path | None = None) -> dict[str, list[str]]:
    """Configuration groups and their options: a listing of the folders and of the sheets, and what needs no file."""
    options = {group: {word} for group, (word, *_) in ABSENT.items()}
    for root in folders(extra):
        files = [path for path in root.glob("*/*.yaml") if path.is_file() and path.parent.name != FOLDER]
        for group, option in [*((path.parent.name, path.stem) for path in files), *map(_parted, entries(root))]:
            options.setdefault(group, set()).add(option)
    return {group: sorted(names) for group, names in sorted(options.items())}


def _parted(name: str) -> tuple[str, str]:
    group, _, option = name.partition("/")
    return group, option


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
        self._options: dict[tuple[str, str], Option] = {}

    def options(self, group: str) -> list[str]:
        """Names of a group's options."""
        return [name for name in self.groups.get(group, ()) if not name.startswith("_")]

    def named(self, group: str, option: Any) -> str | None:
        """The option of this name; None where there is none. `none` is the one that does nothing."""
        if option in self.options(group):
            return str(option)
        return ABSENT[group][0] if option == "none" and group in ABSENT else None

    def find(self, name: str) -> Path | None:
        """The file of a name such as "plant/ideal"; None where there is none."""
        if name in self.entries:
            return self.entries[name].sheet
        return next((path for folder in self.folders if (path := folder / f"{name}.yaml").is_file()), None)

    def meaning(self, group: str, option: str) -> str:
        """What an option is, in words: as its sheet says, or the comment at the head of its file."""
        name = f"{group}/{option}"
        if name in self.entries:
            return self.entries[name].meaning
        path = self.find(name)
        if path is None:
            return ABSENT[group][1]
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        return " ".join(line.lstrip("# ") for line in lines if line.startswith("#") and "@package" not in line)

    def read(self, group: str, option: str) -> tuple[Path, Mapping[str, Any]]:
        """An option's file, and what it says; UsageError where it is none of settings."""
        path, content = self._stated(group, option)
        return path, {key: value for key, value in content.items() if key != LOOK}

    def look(self, group: str, option: str) -> Mapping[str, Any]:
        """How an option is drawn: hue, marker, dash; empty where it does not say."""
        look = self._stated(group, option)[1].get(LOOK) or {}
        return look if isinstance(look, Mapping) else {}

    def _stated(self, group: str, option: str) -> tuple[Path, Mapping[str, Any]]:
        name = f"{group}/{option}"
        if name in self.entries:
            return self.entries[name].sheet, self.entries[name].content
        path = self.find(name)
        if path is None:
            raise UsageError(f"{group}={option}: there is no file {name}.yaml")
        return path, read_mapping(path)

    def option(self, group: str, name: str) -> Option:
        """An option with those that it extends, read once; do not change it."""
        if (group, name) not in self._options:
            self._options[group, name] = self._read_option(group, name, ())
        return self._options[group, name]

    def _read_option(self, group: str, name: str, extending: tuple[str, ...]) -> Option:
        """extending: the options that led here."""
        if self.find(f"{group}/{name}") is None and group in ABSENT and name in ("none", ABSENT[group][0]):
            return Option(ABSENT[group][2], {})
        path, content = self.read(group, name)
        if name in extending:
            raise UsageError(f"{path}: defaults: {group}={name} extends itself")
        own = {str(key): value for key, value in content.items() if key != "defaults"}
        defaults = content.get("defaults") or []
        values: dict[str, Any] = {}
        chosen: dict[str, str] = {}
        inherited: dict[str, str] = {}
        for entry in [*defaults, *([] if "_self_" in defaults else ["_self_"])]:
            text = str(entry)
            if "${" in text:
                raise UsageError(f"{path}: defaults: {text}: an option is chosen by its name, not by a reference")
            if text == "_self_":
                merge(values, own)
            elif isinstance(entry, Mapping) and group in GLOBAL:
                chosen |= self._choices(path, entry)
            elif not isinstance(entry, str):
                raise UsageError(f"{path}: defaults: {text}: an option extends others of its group, by their names")
            elif former := former_name(text, path):
                merge(values, self._former(former))
            else:
                extended = self._read_option(group, text.removesuffix(".yaml"), (*extending, name))
                merge(values, extended.values)
                inherited |= extended.chosen
        return Option(values, inherited | chosen)

    def _choices(self, path: Path, entry: Mapping[Any, Any]) -> dict[str, str]:
        """Options that an entry of `defaults` chooses, such as `override /wind: gust`."""
        choices = {}
        for key, option in entry.items():
            group = str(key).removeprefix("override ").strip().lstrip("/")
            if group not in CHOSEN:
                raise UsageError(f"{path}: defaults: {key}: must be `override /GROUP`, of {', '.join(CHOSEN)}")
            name = self.named(group, option)
            if name is None:
                raise UsageError(f"{path}: defaults: {key}: {option}: there is no such option of {group}")
            choices[group] = name
        return choices

    def _former(self, name: str) -> dict[str, str]:
        if name in FORMER_CLASSES:
            kind = FORMER_TARGET if "/custom" in name else TARGET
            return {kind: f"quadexp.{FORMER_CLASSES[name]}"}
        group, _, option = name.partition("/")
        return {TARGET: self.option(group, option).values[TARGET]}

    def part_of(self, group: str, option: str) -> type[Part] | None:
        """The class of an option's part; None where its file, and those that it extends, name none."""
        values = self.option(group, option).values
        target = values.get(FORMER_TARGET) or values.get(TARGET)
        return part_class(group, str(target)) if target and group in PARTS else None

    def parts(self, group: str) -> dict[str, type[Part]]:
        """The classes of a group's parts, by option; one whose file is wrong is left out: who takes it is told."""
        parts: dict[str, type[Part]] = {}
        for option in self.options(group):
            with contextlib.suppress(UsageError):
                if part := self.part_of(group, option):
                    parts[option] = part
        return parts

    def having(self, key: str) -> dict[str, list[str]]:
        """Dotted keys that are the given one or end in it -> the options, chosen or not, that have it."""
        having: dict[str, list[str]] = {}
        for group in PARTS:
            parts = self.parts(group)
            names = {f"{group}.{name}" for part in parts.values() for name in declared(part)}
            for name in ending_in(key, sorted(names)) + ([key] if key in names else []):
                local = name.removeprefix(f"{group}.")
                options = [f"{group}={option}" for option, part in parts.items() if local in declared(part)]
                having[name] = options[:MOST_NAMED]
        return having


def merge(values: dict[str, Any], over: Mapping[str, Any]) -> None:
    """Set values over others, key by key where both are mappings."""
    for key, value in over.items():
        if isinstance(value, Mapping) and isinstance(values.get(key), dict):
            merge(values[key], value)
        else:
            values[key] = copy.deepcopy(value)


@functools.cache
def units(group: str) -> dict[str, str]:
    """Units of the keys of a group's parts, by name; "" for a number without one."""
    parts = OptionFiles().parts(group).values()
    return {name: one.setting.unit for part in parts for name, one in declared(part).items()}
