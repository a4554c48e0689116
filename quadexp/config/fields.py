"""Fields of a configuration that declare what they may hold, and the check of it.

speed: float = number("(0, 60]", "m/s")        refused: trajectory.speed=-3: must be in (0, 60] m/s
mode: str = choice("random", "setpoints")
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

MISSING: Any = "???"  # OmegaConf's mark of a mandatory value
_INTERVAL = re.compile(r"([\[(])\s*(\S+?),\s*(\S+?)\s*([\])])")


def number(interval: str, unit: str = "", default: Any = MISSING, *, length: int | None = None) -> Any:
    """A field that holds a number (or a list of `length` numbers) inside an interval such as "(0, 60]"."""
    metadata = {"interval": interval, "unit": unit, "length": length}
    return _field(default, metadata)


def choice(*allowed: str, default: Any = MISSING) -> Any:
    """A field that holds one of a few words."""
    return _field(default, {"choices": allowed})


def _field(default: Any, metadata: dict[str, Any]) -> Any:
    if isinstance(default, (list, dict)):
        return field(default_factory=lambda: type(default)(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def _inside(value: float, interval: str) -> bool:
    match = _INTERVAL.fullmatch(interval)
    assert match is not None, interval
    left, low, high, right = match[1], float(match[2]), float(match[3]), match[4]
    above = value >= low if left == "[" else value > low
    below = value <= high if right == "]" else value < high
    return above and below and not math.isnan(value)


def is_set(*values: Any) -> bool:
    """Whether all of these values of a configuration's fields are given."""
    return MISSING not in values


@dataclass
class Checked:
    """Checks the intervals and choices that the fields declare; `prefix` is the key of the node."""

    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if f.metadata and value is not None and value != MISSING:
                check_value(f"{self.prefix}{f.name}", value, f.metadata)


def check_value(key: str, value: Any, metadata: Any) -> None:
    """Raise ValueError where a value lies outside what its field's metadata allow."""
    allowed = metadata.get("choices")
    if allowed and value not in allowed:
        raise ValueError(f"{key}={value}: must be one of {', '.join(allowed)}")
    interval = metadata.get("interval")
    if not interval:
        return
    shown = str(value).replace(" ", "")
    length = metadata.get("length")
    if length and (not isinstance(value, (list, tuple)) or len(value) != length):
        raise ValueError(f"{key}={shown}: must be a list of {length} numbers")
    for item in value if isinstance(value, (list, tuple)) else [value]:
        if not _inside(float(item), interval):
            raise ValueError(f"{key}={shown}: must be in {interval} {metadata.get('unit', '')}".rstrip())
