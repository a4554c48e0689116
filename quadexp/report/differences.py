"""What differs between two records, key by key, and how it is said: as b against a.

difference = b - a,     relative = 100 (b - a) / a    (%)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from quadexp.report.wording import number

ABSENT = "-"
MOST_LINES = 16  # settings shown; --json has all


def flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Nested mappings as dotted keys."""
    if not isinstance(value, Mapping):
        return {prefix[:-1]: value}
    return {key: item for name, inner in value.items() for key, item in flat(inner, f"{prefix}{name}.").items()}


def differing(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Dotted key -> [value in a, value in b], for those that differ; "-" stands for a key that is not there."""
    left, right = flat(a), flat(b)
    keys = list(dict.fromkeys([*left, *right]))
    values = {key: [left.get(key, ABSENT), right.get(key, ABSENT)] for key in keys}
    return {key: pair for key, pair in values.items() if pair[0] != pair[1]}


def change(a: Any, b: Any) -> dict[str, float]:
    """a, b, difference b - a, relative (%), NaN where not defined."""
    a, b = (math.nan if value is None else float(value) for value in (a, b))
    relative = 100 * (b - a) / a if a else (0.0 if a == b else math.nan)
    return {"a": a, "b": b, "difference": b - a, "relative": relative}


def record_of(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """What decides a flight: its configuration, the content of its checkpoint, and the versions that flew it."""
    git = (metadata.get("provenance") or {}).get("git") or {}
    return {
        **(metadata.get("config") or {}),
        "model_sha256": (metadata.get("model_sha256") or "")[:12],
        "versions": {
            **(metadata.get("versions") or {}),
            "sources": metadata.get("sources") or "",
            "commit": (git.get("commit") or "")[:10],
        },
        "backend": metadata.get("backend", ""),
    }


def setting_lines(settings: Mapping[str, list[Any]]) -> list[str]:
    """The settings that differ, a line each, at most as many as fit a screen."""
    if not settings:
        return ["configuration  the same"]
    shown = {key: [_short(value) for value in pair] for key, pair in list(settings.items())[:MOST_LINES]}
    width = max(map(len, shown))
    left = max(len(pair[0]) for pair in shown.values())
    count = f"{len(settings)} setting{'s' if len(settings) > 1 else ''} differ{'' if len(settings) > 1 else 's'}"
    lines = [f"configuration  {count}"]
    lines += [f"  {key:<{width}}  {pair[0]:<{left}}  {pair[1]}" for key, pair in shown.items()]
    rest = len(settings) - len(shown)
    return lines + ([f"  and {rest} more (--json has all)"] if rest else [])


def _short(value: Any, width: int = 36) -> str:
    text = "null" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= width else text[: width - 3] + "..."


def figure_lines(figures: Mapping[str, tuple[Mapping[str, float], float]]) -> list[str]:
    """A table of changes. figures: name -> (change, factor it is shown with)."""
    rows = [["", "a", "b", "b - a", "relative"]]
    for name, (one, factor) in figures.items():
        numbers = [number(factor * one[key]) for key in ("a", "b", "difference")]
        rows.append([name, *numbers, said_relative(one["relative"])])
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    return [
        "  ".join([f"{row[0]:<{widths[0]}}", *(f"{c:>{w}}" for c, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]


def said_relative(value: float) -> str:
    """Such as "-99.1 %", "same", or "-" where there is none."""
    return "-" if math.isnan(value) else "same" if value == 0 else f"{value:+.3g} %"
