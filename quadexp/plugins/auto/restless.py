"""What a table says of commands that remedies=auto makes busier."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import median
from typing import Any

from quadexp.report.notes import Row, known_values
from quadexp.report.pairing import Contestant, condition_of, setting_pairs
from quadexp.report.text import count

SUFFIX = "+auto"  # of the name of a controller with it around
RESTLESS = 2.0  # times as much as without, from which on it is said


def restless(flights: Mapping[Contestant, Sequence[Row]], labels: Mapping[Contestant, str]) -> list[str]:
    """Contestants with remedies=auto whose commands change, or that use the battery, more than RESTLESS times as much
    as without, in the median of the flights that both flew."""
    lines = []
    for who, without in _with_auto(flights):
        for name, what in (("command_change", "commands change"), ("charge_used", "the battery is used")):
            before = _values(flights[without], name)
            after = _values(flights[who], name)
            ratios = [value / before[pair] for pair, value in after.items() if before.get(pair)]
            if ratios and median(ratios) > RESTLESS:
                times = f"{median(ratios):.2g} times as much as of {labels[without]}"
                pairs = f"in the median of {count(len(ratios), 'pair')}"
                lines.append(f"{labels[who]}: {what} {times}, {pairs}")
    return lines


def _values(rows: Sequence[Row], name: str) -> dict[Any, float]:
    """A metric of each flight, by condition and seed."""
    return {(condition_of(row), row["seed"]): value for value, row in known_values(rows, name)}


def _with_auto(contestants: Iterable[Contestant]) -> Iterator[tuple[Contestant, Contestant]]:
    """Each with remedies=auto, and the one that differs from it in nothing but that."""
    others = {}
    for who in contestants:
        settings = dict(setting_pairs(who.settings))
        asked = settings.pop("remedies", "none")
        controller = who.controller.removesuffix(SUFFIX)
        remedies = asked if controller == who.controller else "auto"
        others[controller, who.model, remedies, frozenset(settings.items())] = who
    for (controller, model, remedies, beside), who in others.items():
        without = others.get((controller, model, "none", beside))
        if remedies == "auto" and without is not None:
            yield who, without
