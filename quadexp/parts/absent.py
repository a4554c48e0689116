"""Options of this program that are not there because a plug-in is not: its folder was deleted.

Such an option names a class or a function of the plug-in, or another option that is not there, or one of a group that
the plug-in brings. That is read from its text; nothing is imported.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from quadexp.parts.former import group_of
from quadexp.parts.schema import conf_folder, lacks_plugin
from quadexp.plugin import shipped_plugins

_PLUGIN = re.compile(r"\bquadexp\.plugins\.(\w+)")


def absent(options: Mapping[str, Any]) -> dict[str, str]:
    """Option, such as "trajectory/circle" -> why it is not there. options: definition of all of this program."""
    text = "".join(path.read_text(encoding="utf-8") for path in conf_folder().glob("*/*.yaml"))
    if not _absent_plugin(text):
        return {}
    contents = {name: option.content for name, option in options.items()}
    reasons: dict[str, str] = {}
    before = -1
    while len(reasons) > before:
        before = len(reasons)
        for name in sorted(contents.keys() - reasons.keys()):
            reason = _lacking(name.partition("/")[0], contents[name], reasons)
            if reason:
                reasons[name] = reason
    return reasons


def lacking(group: str) -> str:
    """Why a group of this program is not there, with the plug-in that its options are of."""
    text = "".join(path.read_text(encoding="utf-8") for path in (conf_folder() / group).glob("*.yaml"))
    return f"no installed plug-in has this group (quadexp/plugins/{_absent_plugin(text)} is not there)"


def _absent_plugin(text: str) -> str:
    """The first plug-in that a text names and that is not there; "" where all are."""
    there = shipped_plugins()
    for name in _PLUGIN.findall(text):
        if name not in there:
            return str(name)
    return ""


def _lacking(group: str, content: Mapping[str, Any], reasons: Mapping[str, str]) -> str:
    """What an option of a group needs that is not there; "" for nothing. reasons: of those that are not."""
    if plugin := _absent_plugin(str(content)):
        return f"the plug-in quadexp/plugins/{plugin} is not there"
    for other, option in _named(group, content):
        reason = reasons.get(f"{other}/{option}")
        if option != "none" and lacks_plugin(other):
            reason = lacking(other)
        if reason:
            return f"{other}={option}: {reason}"
    return ""


def _named(group: str, content: Mapping[Any, Any]) -> Iterator[tuple[str, str]]:
    """What may be options of other groups, or of this one: those that are extended, chosen, flown in a sweep."""
    for key, value in content.items():
        other = chosen_group(key)
        if key == "defaults":
            other = group
        elif other.rpartition(".")[2] == "residual":
            other = "model"
        for item in value if isinstance(value, list) else [value]:
            if isinstance(item, Mapping):
                yield from _named(group, item)
                continue
            for text in str(item).split(","):
                words = text.split()
                if words:
                    yield other, words[0]


def chosen_group(key: Any) -> str:
    """The group whose option a key chooses: that of `override /wind`, or the key."""
    return group_of(str(key).removeprefix("override ").strip().lstrip("/"))
