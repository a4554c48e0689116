"""What each command reads of the configuration. What is given besides is refused: it would be without effect.

A word stands for a group with its keys, or for one key. `sweep`: what an experiment varies; `fit`: the keys of a model.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import reduce
from typing import Any

from quadexp.errors import UsageError
from quadexp.names import SPELLINGS, distinct
from quadexp.parts.models import GROUP
from quadexp.parts.schema import BUNDLES, PRESETS, REMEDIES, WORLD, Config
from quadexp.parts.settings import find, shown

CONTROLLER = " ".join(("controller timing remedies", *PRESETS, *REMEDIES))
LOOP = " ".join(("vehicle plant model seed", CONTROLLER, *WORLD, *BUNDLES))
FLIGHT = f"{LOOP} trajectory"
ENGINE = "engine evaluate.workers evaluate.timeout evaluate.memory"
READS = {
    "simulate": FLIGHT,
    "export-controller": FLIGHT,
    "fly": FLIGHT,
    "evaluate": f"{FLIGHT} evaluate.metric evaluate.figures evaluate.log_period",
    "evaluate --sweep": f"{FLIGHT} evaluate engine sweep",
    "tune": f"{FLIGHT} {ENGINE} evaluate.metric evaluate.log_period sweep",
    "bench": ENGINE,
    "bench --controller": CONTROLLER,
    "collect": f"{LOOP} collect",
    "collect --sweep": f"{LOOP} collect sweep",
    "collect --flight": "vehicle collect.frame collect.thrust collect.state collect.target collect.identified",
    "fit": "vehicle fit",
    "validate": "vehicle",
    "show --margins": FLIGHT,
    "qx.controller": FLIGHT,
    "gymnasium.make": " ".join(("vehicle plant seed trajectory world", *WORLD)),
}


def is_read(key: str, command: str) -> bool:
    """Whether a command reads a key, or the group of this name. `model` alone is the checkpoint that is flown."""
    group, dot, _ = key.partition(".")
    if group in SPELLINGS or (group == GROUP and dot):
        key = "fit"
    return any(f"{key}.".startswith(f"{word}.") for word in READS[command].split())


def refuse_unread(command: str, override: str, keys: Iterable[str]) -> None:
    """UsageError where other commands read what an override sets, and this one reads none of it. override: its text."""
    readers = distinct(other for key in keys for other in READS if is_read(key, other))
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
