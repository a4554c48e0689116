"""The settings that are varied, each with its range; see docs/tuning.md.

controller.position_weight=1..1000:log      every entry of a list that is not zero, in the proportions it has now
controller.position_weight.z=1..1000:log    some entries: x, y, z or xy (of four entries the first is w)
controller.nodes=5..20                      a whole number, because the setting is one
controller.position_weight                  without a range: a tenth to ten times of what it is now, logarithmic
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.parts.option_files import folders
from quadexp.parts.plain_data import read_data, unreadable
from quadexp.parts.schema import REMEDIES, Config, remedies
from quadexp.parts.settings import Declared, declared, inside, record

TUNED = ("controller", *REMEDIES)  # groups whose settings can be varied
SPACES = "tune"  # folder of default spaces in a configuration folder
AROUND = 10.0  # factor on the present value, up and down, of a range that is not given
DIGITS = 4  # significant ones of a value that is tried, so that a preset can be read
_RANGE = re.compile(r"([-+.\deE]+)\.\.([-+.\deE]+)(:log)?")
_ENTRIES = {"x": (0,), "y": (1,), "z": (2,), "xy": (0, 1)}


@dataclass(frozen=True)
class Axis:
    """One number that is varied. name: as it was asked for. key: of the setting. entries: of a list, () for a number.
    start: what it is now. whole: whether it is a whole number. value: of the setting now, a number or a list."""

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
    found: dict[str, Any] = {}
    for axis, number in zip(axes, numbers, strict=True):
        if not axis.entries:
            found[axis.key] = number
            continue
        values = list(found.get(axis.key, axis.value))
        for i in axis.entries:
            values[i] = float(f"{number * axis.value[i] / axis.start:.{DIGITS + 2}g}")
        found[axis.key] = values
    return found


def overrides(axes: Sequence[Axis], numbers: Sequence[float]) -> list[str]:
    """The same as overrides."""
    return [f"{key}={_text(value)}" for key, value in settings_of(axes, numbers).items()]


def _text(value: Any) -> str:
    return f"[{','.join(map(repr, value))}]" if isinstance(value, list) else repr(value)


def read_axes(texts: Sequence[str], config: Config, extra: Path | None = None) -> list[Axis]:
    """The axes of a search: as given, or those of the default spaces of the controller and of every remedy around it.

    config: what is tuned, whose values are the start. extra: a configuration folder of the user's own.
    Raises UsageError with one line.
    """
    axes = [_axis(text, config) for text in texts or default_space(config, extra)]
    taken: set[tuple[str, int]] = set()
    for axis in axes:
        entries = {(axis.key, i) for i in axis.entries or (-1,)}
        if taken & entries:
            raise UsageError(f"--vary {axis.name}: is varied twice")
        taken |= entries
    return axes


def default_space(config: Config, extra: Path | None = None) -> list[str]:
    """The axes of spaces.yaml, or of the user's tune/NAME.yaml, by name or kind of the controller, and by name of each
    remedy. A range that does not contain the present value is left out: a decade up and down is taken."""
    found: list[str] = []
    nodes: dict[str, Any] = {"controller": config.controller, **remedies(config)}
    for group, node in nodes.items():
        names = list(dict.fromkeys([node.name, node.former_kind or node.name]))
        space = _space(names, extra)
        if space is None and group == "controller":
            raise UsageError(
                f"{node.name}: no default space to tune it in: give --vary KEY=LOW..HIGH, or a file"
                f" {SPACES}/{names[-1]}.yaml in your --conf folder"
            )
        for key, rule in (space or {}).items():
            name = f"{group}.{key}"
            found.append(f"{name}={rule}" if rule is not None and _contains(name, str(rule), config) else name)
    return found


def _contains(name: str, rule: str, config: Config) -> bool:
    key, part, value = _value(name, config)
    start = _entries(name, part, value, _declared(config, key))[1]
    low, high, _ = _limits(name, rule, start)
    return low <= start <= high


def _space(names: Sequence[str], extra: Path | None) -> Mapping[str, Any] | None:
    import yaml

    shipped = yaml.safe_load((files("quadexp.tune") / "spaces.yaml").read_text(encoding="utf-8"))
    for name in names:
        for folder in reversed(folders(extra)):
            path = folder / SPACES / f"{name}.yaml"
            if not path.is_file():
                continue
            try:
                content = read_data(path)
            except (yaml.YAMLError, UnicodeDecodeError) as error:
                raise unreadable(path, error) from None
            if not isinstance(content, dict):
                raise UsageError(f"{path}: must be a mapping {{key: LOW..HIGH}}")
            return content
        if name in shipped:
            return dict(shipped[name])
    return None


def _axis(text: str, config: Config) -> Axis:
    name, equals, rule = text.partition("=")
    group = name.partition(".")[0]
    if group not in TUNED:
        raise UsageError(f"--vary {name}: what is tuned is the controller and what is around it: {', '.join(TUNED)}")
    key, part, value = _value(name, config)
    one = _declared(config, key)
    entries, start, whole = _entries(name, part, value, one)
    low, high, log = _limits(name, rule if equals else "", start)
    if whole and not (float(low).is_integer() and float(high).is_integer()):
        raise UsageError(f"--vary {text}: {key} is a whole number")
    if not low <= start <= high:
        raise UsageError(f"--vary {name}={low:g}..{high:g}: must contain {start:g}, which it is now")
    if not low < high:
        raise UsageError(f"--vary {text}: the range is empty")
    if one is not None and one.setting.interval:
        ends = [end if whole else float(f"{end * (value[i] / start if entries else 1):.6g}")
                for end in (low, high) for i in (entries or (0,))]  # fmt: skip
        if wrong := [end for end in ends if not inside(end, one.setting.interval)]:
            unit = one.setting.unit
            raise UsageError(f"--vary {name}: {wrong[0]:g}: must be in {one.setting.interval} {unit}".rstrip())
    return Axis(name, key, entries, low, high, log, whole, start, value)


def _value(name: str, config: Config) -> tuple[str, str, Any]:
    """Key, letters of its entries ("" for all) and present value of what a name means."""
    group, *parts = name.split(".")
    node: Any = record(getattr(config, group))
    for i, part in enumerate(parts):
        if isinstance(node, list) and i == len(parts) - 1 and part in _ENTRIES:
            return ".".join([group, *parts[:-1]]), part, node
        if not isinstance(node, dict) or part not in node:
            near = [f"{'.'.join([group, *parts[:i]])}.{key}" for key in node] if isinstance(node, dict) else []
            raise UsageError(f"--vary {name}: no such key{suggestion(name, near)}")
        node = node[part]
    return name, "", node


def _declared(config: Config, key: str) -> Declared | None:
    """How a setting is declared; None for an option of a part of the user's own."""
    group, *parts = key.split(".")
    node: Any = type(getattr(config, group))
    for part in parts:
        one = declared(node).get(part) if node is not None else None
        if one is None:
            return None
        node = one.node
    return one


def _entries(name: str, part: str, value: Any, one: Declared | None) -> tuple[tuple[int, ...], float, bool]:
    """Entries that are varied, () for a number; what they are now (the first of them); whether it is a whole number."""

    def number(x: Any) -> bool:
        return isinstance(x, (int, float)) and not isinstance(x, bool) and math.isfinite(x)

    if isinstance(value, list) and value and all(map(number, value)):
        shift = 1 if len(value) == 4 else 0
        chosen = tuple(i + shift for i in _ENTRIES[part]) if part else tuple(i for i, x in enumerate(value) if x)
        if not chosen or any(i >= len(value) or not value[i] for i in chosen):
            raise UsageError(f"--vary {name}: an entry of {value} is zero: set it first, as KEY=VALUE")
        return chosen, float(value[chosen[0]]), False
    if part or not number(value):
        raise UsageError(f"--vary {name}: is {value}, not a number or a list of numbers")
    whole = isinstance(value, int) and (one is None or one.type is int or int in get_args(one.type))
    return (), value, whole


def _limits(name: str, rule: str, start: float) -> tuple[float, float, bool]:
    """Low, high, and whether the scale is logarithmic."""
    if not rule:
        if not start > 0:
            raise UsageError(f"--vary {name}: is {start:g} now: give its range, as {name}=LOW..HIGH")
        if isinstance(start, int):
            return max(1, round(start / 2)), 2 * start, False
        return start / AROUND, AROUND * start, True
    match = _RANGE.fullmatch(rule.replace(" ", ""))
    try:
        assert match is not None
        low, high = float(match[1]), float(match[2])
    except (AssertionError, ValueError):
        raise UsageError(f"--vary {name}={rule}: expected LOW..HIGH or LOW..HIGH:log, such as 1..1000:log") from None
    if match[3] and not low > 0:
        raise UsageError(f"--vary {name}={rule}: a logarithmic range begins above 0")
    return low, high, bool(match[3])
