"""The settings that are varied, each with its range; see docs/tuning.md.

controller.position_weight=1..1000:log      every entry of a list that is not zero, in the proportions it has now
controller.position_weight.z=1..1000:log    some entries: x, y, z or xy (of four entries the first is w)
controller.nodes=5..20                      a whole number, because the setting is one
controller.position_weight                  without a range: a tenth to ten times of what it is now, logarithmic
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from quadexp.errors import ForbiddenValueError, UsageError
from quadexp.messages import suggestion
from quadexp.parts.schema import REMEDIES, Config, remedies
from quadexp.parts.settings import Settings, declared, record

TUNED = ("controller", *REMEDIES)  # groups whose settings can be varied
AROUND = 10.0  # factor on the present value, up and down, of a range that is not given
DIGITS = 4  # significant ones of a value that is tried, so that a preset can be read
_ENTRIES = {"x": (0,), "y": (1,), "z": (2,), "xy": (0, 1)}


@dataclass(frozen=True)
class Axis:
    """One number that is varied. name: as it was asked for. key: of the setting. entries: of a list, () for a number.
    start: what it is now, of a list the first of them. whole: whether it is a whole number. value: of the setting now,
    a number or a list."""

    name: str
    key: str
    entries: tuple[int, ...]
    low: float
    high: float
    log: bool
    whole: bool
    start: float
    value: Any

    def rounded(self, number: float) -> float:
        """The number as it is flown and written, within the range."""
        if self.whole:
            return int(number)
        return min(max(float(f"{number:.{DIGITS}g}"), self.low), self.high)

    def text(self) -> str:
        """As on the command line, with its range."""
        return f"{self.name}={self.low:g}..{self.high:g}{':log' if self.log else ''}"


def settings_of(axes: Sequence[Axis], numbers: Sequence[float]) -> dict[str, Any]:
    """Key -> value of every setting that the axes change, with one number for each axis."""
    settings: dict[str, Any] = {}
    for axis, number in zip(axes, numbers, strict=True):
        if not axis.entries:
            settings[axis.key] = number
            continue
        values = list(settings.get(axis.key, axis.value))
        for i in axis.entries:
            values[i] = float(f"{number * axis.value[i] / axis.start:.{DIGITS + 2}g}")
        settings[axis.key] = values
    return settings


def overrides(axes: Sequence[Axis], numbers: Sequence[float]) -> list[str]:
    """The same as overrides."""
    return [f"{key}={_text(value)}" for key, value in settings_of(axes, numbers).items()]


def _text(value: Any) -> str:
    if isinstance(value, list):
        return f"[{','.join(map(repr, value))}]"
    return repr(value)


def read_axes(texts: Sequence[str], config: Config) -> list[Axis]:
    """The axes of a search: as given, or those that the keys of the controller and of every compensation around it say.

    config: what is tuned, whose values are the start. Raises UsageError with one line.
    """
    axes = [_axis(text, config) for text in texts or default_space(config)]
    taken: set[tuple[str, int]] = set()
    for axis in axes:
        entries = {(axis.key, i) for i in axis.entries or (-1,)}
        if taken & entries:
            raise UsageError(f"--vary {axis.name}: is varied twice")
        taken |= entries
    return axes


def default_space(config: Config) -> list[str]:
    """The ranges that the keys say (Setting.tuned). One that does not contain the present value is left out: a decade
    up and down is taken. Raises UsageError where the controller has none."""
    space: list[str] = []
    for group, node in {"controller": config.controller, **remedies(config)}.items():
        rules = [
            f"{group}.{key}{rule if rule.startswith('.') else f'={rule}'}"
            for key, field in declared(type(node)).items()
            for rule in field.setting.tuned.split()
        ]
        if not rules and group == "controller":
            raise UsageError(f"{node.name}: its keys say no ranges to tune it in: give --vary KEY=LOW..HIGH")
        for text in rules:
            name, _, rule = text.partition("=")
            start = _varied(name, config)[0].start
            low, high, _ = _limits(name, rule, start)
            space.append(text if low <= start <= high else name)
    return space


def _axis(text: str, config: Config) -> Axis:
    name, equals, rule = text.partition("=")
    if name.partition(".")[0] not in TUNED:
        raise UsageError(f"--vary {name}: what is tuned is the controller and what is around it: {', '.join(TUNED)}")
    axis, owner = _varied(name, config)
    low, high, log = _limits(name, rule if equals else "", axis.start)
    if axis.whole and not (float(low).is_integer() and float(high).is_integer()):
        raise UsageError(f"--vary {text}: {axis.key} is a whole number")
    if not low <= axis.start <= high:
        raise UsageError(f"--vary {name}={low:g}..{high:g}: must contain {axis.start:g}, which it is now")
    if not low < high:
        raise UsageError(f"--vary {text}: the range is empty")
    axis = replace(axis, low=low, high=high, log=log)
    for end in (low, high) if isinstance(owner, Settings) else ():
        try:
            replace(owner, **{axis.key.rpartition(".")[2]: settings_of([axis], [axis.rounded(end)])[axis.key]})
        except ForbiddenValueError as error:
            raise UsageError(f"--vary {name}: {error}") from None
        except UsageError:  # it contradicts another setting as it is now: a trial that does is a lost one
            pass
    return axis


def _varied(name: str, config: Config) -> tuple[Axis, Any]:
    """What a name means in a configuration, an axis without its range, and what has the setting.

    Raises UsageError where the name is of no number, nor of a list of them without zeros.
    """
    group, *parts = name.split(".")
    key = name
    letters = ""
    owner = getattr(config, group)
    value: Any = record(owner)
    for i, part in enumerate(parts):
        if isinstance(value, list) and i == len(parts) - 1 and part in _ENTRIES:
            key = name.rpartition(".")[0]
            letters = part
        elif isinstance(value, dict) and part in value:
            owner = owner if i == 0 else getattr(owner, parts[i - 1], None)
            value = value[part]
        else:
            near = value if isinstance(value, dict) else ()
            hint = suggestion(name, [f"{'.'.join([group, *parts[:i]])}.{known}" for known in near])
            raise UsageError(f"--vary {name}: no such key{hint}")
    if isinstance(value, list) and value and all(map(_is_number, value)):
        first = 1 if len(value) == 4 else 0
        entries = [i + first for i in _ENTRIES[letters]] if letters else [i for i, x in enumerate(value) if x]
        if not entries or any(i >= len(value) or not value[i] for i in entries):
            raise UsageError(f"--vary {name}: an entry of {value} is zero: set it first, as KEY=VALUE")
        start = float(value[entries[0]])
        return Axis(name, key, tuple(entries), start, start, False, False, start, value), owner
    if letters or not _is_number(value):
        raise UsageError(f"--vary {name}: is {value}, not a number or a list of numbers")
    return Axis(name, key, (), value, value, False, isinstance(value, int), value, value), owner


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _limits(name: str, rule: str, start: float) -> tuple[float, float, bool]:
    """Low, high, and whether the scale is logarithmic."""
    if not rule:
        if not start > 0:
            raise UsageError(f"--vary {name}: is {start:g} now: give its range, as {name}=LOW..HIGH")
        if isinstance(start, int):
            return max(1, round(start / 2)), 2 * start, False
        return start / AROUND, AROUND * start, True
    log = rule.endswith(":log")
    low_text, _, high_text = rule.removesuffix(":log").partition("..")
    try:
        low = float(low_text)
        high = float(high_text)
    except ValueError:
        low = high = math.nan
    if not math.isfinite(high - low):
        raise UsageError(f"--vary {name}={rule}: expected LOW..HIGH or LOW..HIGH:log, such as 1..1000:log")
    if log and not low > 0:
        raise UsageError(f"--vary {name}={rule}: a logarithmic range begins above 0")
    return low, high, log
