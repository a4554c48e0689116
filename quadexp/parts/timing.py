"""Which delays a controller and the parts around it are given, in one place: the group `timing=`.

    age          of the measured state                 .age of a controller and of what is around it, see Part.age_key
    dead_time    from a command to its thrust          likewise .dead_time
    motor_lag    of the thrust behind its command      likewise .motor_lag; of an MPC as `motor=` says:
                                                       states .motor_lag, lead .motor_lead, dead_time .dead_time

A part that asks its controller (null) is given by it. What is set on a part itself counts over what is given here.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

from quadexp.errors import UsageError
from quadexp.messages import MOST_NAMED
from quadexp.parts.options import OptionFiles
from quadexp.parts.part import Part
from quadexp.parts.schema import REMEDIES, Config
from quadexp.parts.settings import declared, key, keyed
from quadexp.parts.user_modules import own_folders

PARTS = ("controller", *REMEDIES)  # that may be given, the controller first
TIMES = ("age", "dead_time", "motor_lag")


@keyed
class Timing(Part):
    """Delays that are known."""

    prefix = "timing."

    age: float | None = key(None, "of the measured state; null: not given", "[0, 0.5]", "s")
    dead_time: float | None = key(None, "from a command to its thrust; null: not given", "[0, 0.5]", "s")
    motor_lag: float | None = key(
        None, "time constant of the thrust behind its command; null: not given", "[0, 0.5]", "s"
    )


def with_timing(config: Config, given: Collection[str], motor: str) -> Config:
    """The configuration with its parts given what `timing` holds.

    given: keys that were set by themselves. motor: the option of the group of this name.
    Raises UsageError for one of its keys that was set and that no part of the configuration takes.
    """
    known = {name: value for name in TIMES if (value := getattr(config.timing, name)) is not None}
    taken = set[str]()
    alone = ""
    for group in PARTS:
        part = getattr(config, group)
        alone = f"{group}={part.name}" if getattr(part, "alone", False) else alone
        names = declared(type(part))
        changes: dict[str, Any] = {}
        for name, value in known.items():
            at = part.age_key if name == "age" else name
            if name == "motor_lag" and motor == "dead_time" and group == "controller":
                at = "dead_time"
                value = value + known.get("dead_time", 0.0)
            elif name == "motor_lag" and getattr(part, "motor_lead", None):
                at = "motor_lead"
            if at not in names:
                continue
            taken.add(name)
            asks = getattr(part, at) is None and at in declared(type(config.controller))
            if f"{group}.{at}" not in given and not asks:
                changes[at] = value
        if changes:
            config = replace(config, **{group: replace(part, **changes)})
    for name, value in known.items():
        text = f"timing.{name}={value:g}"
        if value and alone and f"timing.{name}" in given:
            raise UsageError(f"{text}: {alone} finds delays itself; leave it out")
        if name not in taken and f"timing.{name}" in given:
            these = f"; parts that do: {', '.join(options[:MOST_NAMED])}" if (options := takers(name)) else ""
            raise UsageError(f"{text}: nothing in this configuration uses it{these}")
    return config


def takers(name: str) -> list[str]:
    """The options that take a key of `timing` and need no checkpoint, GROUP=OPTION, those around a controller first."""
    files = OptionFiles(own_folders())
    options = []
    for group in (*REMEDIES, "controller"):
        for option, part in files.parts(group).items():
            takes = (part.age_key if name == "age" else name) in declared(part)
            if takes and "models" not in files.option(group, option).values:
                options.append(f"{group}={option}")
    return options
