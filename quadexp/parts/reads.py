"""What each command reads of the configuration. What is given besides is refused: it would be without effect.

A command says it in BRINGS["reads"] (quadexp/plugin.py), in words: a group with its keys, one key, or a name of SETS.
`sweep`: what an experiment varies; `fit`: the keys of a model.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache, reduce
from typing import Any

from quadexp.errors import UsageError
from quadexp.names import SPELLINGS, distinct
from quadexp.parts.models import GROUP
from quadexp.parts.schema import BUNDLES, PRESETS, REMEDIES, WORLD, Config
from quadexp.parts.settings import find, shown
from quadexp.plugin import places, shipped_places

CONTROLLER = ("controller", "timing", "remedies", *PRESETS, *REMEDIES)
LOOP = ("vehicle", "plant", "model", "seed", *CONTROLLER, *WORLD, *BUNDLES)
SETS = {
    "CONTROLLER": CONTROLLER,
    "WORLD": ("vehicle", "plant", "seed", "trajectory", "world", *WORLD),
    "LOOP": LOOP,
    "FLIGHT": (*LOOP, "trajectory"),
    "ENGINE": ("engine", "evaluate.workers", "evaluate.timeout", "evaluate.memory"),
}


@cache
def reads(command: str) -> tuple[str, ...]:
    """Groups and keys that a command reads, or what else is asked of this program."""
    words = shipped_places("reads").get(command) or places("reads")[command]
    return tuple(key for word in words.split() for key in SETS.get(word, (word,)))


def is_read(key: str, command: str) -> bool:
    """Whether a command reads a key, or the group of this name. `model` alone is the checkpoint that is flown."""
    group, dot, _ = key.partition(".")
    if group in SPELLINGS or (group == GROUP and dot):
        key = "fit"
    return any(f"{key}.".startswith(f"{word}.") for word in reads(command))


def refuse_unread(command: str, override: str, keys: Iterable[str]) -> None:
    """UsageError where other commands read what an override sets, and this one reads none of it. override: its text."""
    commands = (*shipped_places("reads"), command)
    readers = distinct(other for key in keys for other in commands if is_read(key, other))
    if not readers or command in readers:
        return
    advice = "add --sweep" if f"{command} --sweep" in readers else f"it is for {', '.join(readers)}"
    raise UsageError(f"{override}: is not used by {command}; {advice}")


def refuse_idle(config: Config, key: str, override: str) -> None:
    """UsageError where a key has no effect with the other settings of its part (Setting.when). override: its
    override."""
    refuse_without_effect(getattr(config, key.partition(".")[0]), key, override)


def refuse_without_effect(part: Any, key: str, override: str) -> None:
    """The same for a key of a part."""
    _, _, name = key.partition(".")
    about = find(type(part), name) if name else None
    if about is None or not about.setting.when:
        return
    above, _, _ = name.rpartition(".")
    other, _, wanted = about.setting.when.partition("=")
    value = getattr(reduce(getattr, above.split(".") if above else [], part), other)
    if shown(value) != wanted if wanted else not value:
        raise UsageError(f"{override}: has no effect with {key.rpartition('.')[0]}.{other}={shown(value)}")
