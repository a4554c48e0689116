"""What a run of a tracker holds of a flight: its settings, its numbers (SI units) and what it was flown by."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from quadexp.messages import tracker_name, tracker_text
from quadexp.report.axes.frame import SweepFrame, is_metric, is_number
from quadexp.report.result_rows import ROW_COLUMNS

TAGS = ("outcome", "cause", "backend", "program", "sources", "libraries", "key")


class Run(NamedTuple):
    """settings: key -> value, of what was asked for. numbers: metric -> value, without those that are missing. tags:
    texts."""

    name: str
    settings: dict[str, Any]
    numbers: dict[str, float]
    tags: dict[str, str]
    ended: bool


def runs(frame: SweepFrame) -> Iterator[Run]:
    """A run for every flight, in the order of the sweep."""
    names = [name for name in ROW_COLUMNS if not is_metric(name) and name not in (*TAGS, "variant", "speed")]
    keys = list(dict.fromkeys([*names, "trajectory.speed", *frame.swept]))
    columns = {key: frame.column(key) for key in keys}
    for i, row in enumerate(frame.rows):
        given = {key: column[i] for key, column in columns.items() if column[i] is not None}
        settings = {key: tracker_text(value) if isinstance(value, str) else value for key, value in given.items()}
        numbers = {
            name: float(row[name])
            for name in ROW_COLUMNS
            if is_metric(name) and is_number(row.get(name)) and math.isfinite(row[name])
        }
        tags = {name: tracker_text(row[name]) for name in TAGS if row.get(name)}
        parts = [row["controller"], row["trajectory"], row["variant"] or "", f"seed {row['seed']}"]
        yield Run(tracker_name(" ".join(filter(None, parts))), settings, numbers, tags, row["outcome"] == "ok")
