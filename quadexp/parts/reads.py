"""What each command reads of the configuration. What is given besides is refused: it would be without effect.

A name stands for a group, or for one key. `sweep`: what an experiment varies.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from quadexp.errors import UsageError
from quadexp.parts.schema import BUNDLES, PRESETS, REMEDIES, WORLD, Config
from quadexp.parts.settings import Settings, declared, shown

LOOP = ("vehicle", "plant", *WORLD, "controller", *PRESETS, *REMEDIES, *BUNDLES, "model", "seed")
FLIGHT = (*LOOP, "trajectory")
ENGINE = ("engine", "evaluate.workers", "evaluate.timeout", "evaluate.memory")
READS = {
    "simulate": FLIGHT,
    "evaluate": (*FLIGHT, "evaluate.metric", "evaluate.figures", "evaluate.log_period"),
    "evaluate --sweep": (*FLIGHT, "evaluate", "engine", "sweep"),
    "tune": (*FLIGHT, *ENGINE, "evaluate.metric", "evaluate.log_period", "sweep"),
    "bench": ENGINE,
    "collect": (*LOOP, "collect"),
    "collect --sweep": (*LOOP, "collect", "sweep"),
    "collect --flight": (
        "vehicle",
        *(f"collect.{key}" for key in ("frame", "thrust", "state", "target", "identified")),
    ),
    "fit-gp": ("vehicle", "gp"),
    "fit-drag": ("vehicle", "drag"),
    "fit-nn": ("vehicle", "nn"),
    "validate": ("vehicle",),
    "show --margins": FLIGHT,
    "qx.controller": FLIGHT,
}


def refuse_idle(config: Config, key: str, given: str) -> None:
    """UsageError where a key has no effect with the other settings of its part (Setting.when). given: its override."""
    above, _, name = key.rpartition(".")
    part: Any = config
    for step in above.split(".") if above else ():
        part = getattr(part, step, None)
    about = declared(type(part)).get(name) if isinstance(part, Settings) else None
    if about is None or not about.setting.when:
        return
    other, _, wanted = about.setting.when.partition("=")
    value = getattr(part, other)
    if shown(value) != wanted if wanted else not value:
        raise UsageError(f"{given}: has no effect with {above}.{other}={shown(value)}")


def is_read(key: str, command: str) -> bool:
    """Whether a command reads a key, or some key of a group."""
    return any(f"{key}.".startswith(f"{name}.") or name.startswith(f"{key}.") for name in READS[command])


def refuse_unread(command: str, given: str, keys: Sequence[str]) -> None:
    """UsageError where a command reads none of the keys that an override sets, and others do. given: its text."""
    readers = [other for other in READS if any(is_read(key, other) for key in keys)]
    if not readers or command in readers:
        return
    names = keys if len(keys) == 1 else dict.fromkeys(key.partition(".")[0] for key in keys)
    advice = "add --sweep" if f"{command} --sweep" in readers else f"it is for {', '.join(readers)}"
    raise UsageError(f"{given}: {command} does not use {' and '.join(names)}: {advice}")
