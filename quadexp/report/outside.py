"""What tables, pages and summaries say of flights that left the data of their controller's learned model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from quadexp.identify.support import WORTH_SAYING
from quadexp.report.pairing import contestant_labels, contestant_of

MOST_NAMED = 4
UNITS = {"thrust": "N", "speed": "m/s", "v": "m/s", "w": "rad/s", "u": "N"}


def outside_line(record: Mapping[str, Any] | None, *, always: bool = False) -> list[str]:
    """One line on a flight: where more than WORTH_SAYING of its samples were outside, or it is unknown; or always."""
    if record is None:
        return []
    share = record["share"]
    if share is None:
        return [f"data        unknown whether the flight lay inside the data of {record['model']}: {record['note']}"]
    if share <= WORTH_SAYING and not always:
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


def outside_notes(rows: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """Footnotes below a table of result rows: who flew outside the data of his model, where, and by how much."""
    labels = contestant_labels(list(dict.fromkeys(map(contestant_of, rows))))
    shares: dict[tuple[str, str], list[float]] = {}
    unknown: dict[str, None] = {}
    for row in rows:
        share, model = row.get("outside_data"), row.get("model")
        if not model or row.get("outcome") in ("failed", "infeasible"):
            continue
        label = labels[contestant_of(row)]
        if share is None or share != share:
            unknown[label] = None
            continue
        speed = row.get("speed")
        course = row["trajectory"] + ("" if speed is None or speed != speed else f" {speed:g}")
        shares.setdefault((label, course), []).append(float(share))
    means = {key: sum(values) / len(values) for key, values in shares.items()}
    far = sorted((key for key, mean in means.items() if mean > WORTH_SAYING), key=lambda key: -means[key])
    said = []
    if far:
        named = [f"{label} on {course} {100 * means[label, course]:.0f} %" for label, course in far[:MOST_NAMED]]
        more = f", and {len(far) - MOST_NAMED} more" if len(far) > MOST_NAMED else ""
        said.append(f"samples outside the data of the fit, where the model extrapolates: {', '.join(named)}{more}")
    if unknown:
        said.append(f"unknown whether inside the data of the fit (older checkpoint or table): {', '.join(unknown)}")
    return tuple(said)
