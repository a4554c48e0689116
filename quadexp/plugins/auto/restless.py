"""What a table says of commands that remedies=auto makes busier."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from statistics import median

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
            before, after = (
                {(condition_of(row), row["seed"]): value for value, row in known_values(flights[each], name)}
                for each in (without, who)
            )
            ratios = [value / before[pair] for pair, value in after.items() if before.get(pair)]
            if ratios and (ratio := median(ratios)) > RESTLESS:
                pairs_text = f"in the median of {count(len(ratios), 'pair')}"
                lines.append(f"{labels[who]}: {what} {ratio:.2g} times as much as of {labels[without]}, {pairs_text}")
    return lines


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
