"""What plug-ins bring, by the words under which people know it: commands, options, groups of the configuration.

Read from BRINGS of each plug-in, and from the options that are not there without it.
"""

import importlib
import re
from functools import cache
from types import SimpleNamespace
from unittest import mock

from quadexp.parts import absent
from quadexp.parts.options import _stated
from quadexp.parts.schema import conf_folder
from quadexp.plugin import shipped_plugins


@cache
def options_of(plugin: str) -> frozenset[str]:
    """Options, such as "controller/pid", that are not there without a plug-in; but for those of its groups."""
    others = tuple(name for name in shipped_plugins() if name != plugin)
    with mock.patch.object(absent, "shipped_plugins", lambda: others):
        return frozenset(absent.absent(shipped_options()))


@cache
def shipped_options() -> dict[str, SimpleNamespace]:
    """Option -> what is stated of it, read once."""
    return {name: SimpleNamespace(content=each.content) for name, each in _stated(0, conf_folder())}


@cache
def words_of(plugin: str) -> frozenset[str]:
    """What can be typed or read only with a plug-in."""
    brings = importlib.import_module(f"quadexp.plugins.{plugin}").BRINGS
    words = {f"quadexp/plugins/{plugin}", f"quadexp.plugins.{plugin}"}
    words |= {f"quadexp {command}" for command in brings.get("commands", {})}
    words |= {f"--{key.partition(' --')[2]}" for key in brings.get("alternatives", {})}
    words |= {f"{group}{sign}" for group in brings.get("groups", {}) for sign in "=."}
    words |= {option.replace("/", "=") for option in options_of(plugin)}
    names = {option.partition("/")[2] for option in options_of(plugin)}
    words |= {name for name in (*names, *brings.get("models", {})) if "_" in name}
    return frozenset(words)


def named_in(text: str, plugin: str) -> list[str]:
    """The words of a plug-in that a text has."""
    found = []
    for word in words_of(plugin):
        end = "(?=[a-z])" if word[-1] in "=." else r"(?![\w-])"
        if word in text and re.search(rf"(?<![\w.-]){re.escape(word)}{end}", text):
            found.append(word)
    return found
