"""What is said of a flight that left the data of its controller's learned model; of rows see notes.py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from quadexp.learn.support import REPORTED_SHARE

UNITS = {"thrust": "N", "speed": "m/s", "v": "m/s", "w": "rad/s", "u": "N"}


def outside_line(record: Mapping[str, Any] | None, *, always: bool = False) -> list[str]:
    """One line on a flight: where more than REPORTED_SHARE of its samples were outside, or it is unknown; or always."""
    if record is None:
        return []
    share = record["share"]
    if share is None:
        return [f"data        unknown whether the flight lay inside the data of {record['model']}: {record['note']}"]
    if share <= REPORTED_SHARE and not always:
        return []
    text = f"data        {100 * share:.1f} % of samples outside the data that {record['model']} was fitted to"
    worst = sorted(record["shares"], key=lambda name: -record["shares"][name])[:3]
    parts = [
        f"{name} {100 * record['shares'][name]:.1f} %, fitted on {low:.3g} to {high:.3g} {_unit(name)}"
        for name in worst
        for low, high in [record["ranges"][name]]
        if record["shares"][name] > 0
    ]
    return [text + (f" ({'; '.join(parts)})" if parts else "")]


def range_lines(ranges: Mapping[str, Sequence[float]]) -> list[str]:
    """What the data of a checkpoint cover, in one line."""
    if not ranges:
        return ["covers      unknown: fitted by an older version; fit it again"]
    parts = [f"{name} {low:.3g} to {high:.3g} {_unit(name)}" for name, (low, high) in ranges.items()]
    return [f"covers      {', '.join(parts)}; each by itself"]


def _unit(feature: str) -> str:
    return UNITS.get(feature, UNITS.get(feature.partition("_")[0], ""))
