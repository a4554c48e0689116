"""The lines below a table: what its numbers are, who is best, and what else the rows tell; and a flight's use of data.

Printed under the error table (terminal, table.md, table.tex) and on the report's page. A note about another column of
the rows is another function in OF_A_CONTESTANT; it is called with the rows of each contestant, and the column may be
missing in them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from statistics import median
from typing import TYPE_CHECKING, Any

from quadexp.log.outcome import RULE, UNFLOWN
from quadexp.report.checked import programs_text
from quadexp.report.pairing import (
    Contestant,
    condition_of,
    contestant_labels,
    contestant_of,
    grouped,
    is_bound,
    is_invalid,
    setting_pairs,
)
from quadexp.report.text import count, speed_text

if TYPE_CHECKING:  # `quadexp show` and `simulate` need no statistics
    from quadexp.report.significance import Tests
    from quadexp.report.statistics import Statistic
    from quadexp.report.winner import Verdict

LARGE_HEADING_ERROR = math.radians(10.0)  # rad, RMS over a flight
REPORTED_SHARE = 0.01  # least share of samples outside the data that is reported for a flight
MOST_CONTESTANTS = 10  # that a kind of note has a line on
RESTLESS = 2.0  # times as much as the baseline, from which on it is said
MOST_CAUSES = 3  # of invalid combinations that are named
UNITS = {"thrust": "N", "speed": "m/s", "v": "m/s", "w": "rad/s", "u": "N"}  # of a feature, by the start of its name

Row = Mapping[str, Any]


def table_notes(
    statistics: Sequence[Statistic], tests: Tests, pooled: Sequence[Statistic] = (), best: Sequence[Verdict] = ()
) -> tuple[str, ...]:
    """What the numbers of a table are, who is best, and each contestant against the baseline over all conditions."""
    seeds = sorted({s.seeds for s in statistics})
    over = count(seeds[0], "seed") if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]} seeds"
    lost = any(s.failures for s in statistics)
    line = f"mean over {'the flights of a line that all completed, of ' if lost else ''}{over}"
    if any(s.common_interval == "t" for s in statistics):
        line += f" [{100 * statistics[0].confidence:g} % interval: Student's t]"
    line += "; oracles are not ranked" if any(is_bound(s.controller) for s in statistics) else ""
    lines = [line, *tests.notes]
    if not any(s.baseline for s in statistics) and len({s.contestant for s in statistics}) > 1:
        lines.append("no comparison: the baseline (evaluate.baseline) is none of these contestants, or several of them")
    lines += [RULE] if lost else []
    if any(s.n > s.common for s in statistics):
        lines.append("all n: the mean over all n flights that this controller completed, also where others did not")
    lines += [text for verdict in best if (text := verdict.text())]
    return (*lines, *_first([entry.text() for entry in pooled]))


def _first(lines: Sequence[str]) -> list[str]:
    """The lines on each contestant; of many the first ones, and how many more there are."""
    rest = len(lines) - MOST_CONTESTANTS
    return [*lines[:MOST_CONTESTANTS], f"and {rest} more of this kind: statistics.csv"] if rest > 1 else [*lines]


def notes(rows: Sequence[Row]) -> list[str]:
    """The notes on result rows; empty if there are none."""
    invalid = [text] if (text := invalid_text(rows)) else []
    rows = [row for row in rows if not is_invalid(row)]
    flights = grouped((contestant_of(row), row) for row in rows)
    labels = contestant_labels(list(flights))
    lines = []
    for note in OF_A_CONTESTANT:
        lines += _first([f"{labels[who]}: {text}" for who, flown in flights.items() if (text := note(flown))])
    lines += _first(restless(flights, labels))
    programs = len({(row.get("program"), row["sources"]) if row.get("sources") else None for row in rows})
    mixed = [f"flights of {programs} programs stand side by side: {programs_text(rows)}"] if programs > 1 else []
    return invalid + lines + mixed


def invalid_text(rows: Sequence[Row]) -> str:
    """How many cells are invalid, and why; "" where none is."""
    causes = Counter(row["cause"] for row in rows if is_invalid(row))
    if not causes:
        return ""
    shown = [f"{cause} ({n})" if len(causes) > 1 else cause for cause, n in causes.most_common(MOST_CAUSES)]
    shown += [f"and {len(causes) - MOST_CAUSES} other causes"] if len(causes) > MOST_CAUSES else []
    return f"{causes.total()} of {len(rows)} combinations are invalid and were not flown: {'; '.join(shown)}"


def _known(rows: Sequence[Row], name: str) -> Iterator[tuple[float, Row]]:
    """The values of a column with their rows, without those that are missing."""
    for row in rows:
        if row.get(name) not in (None, "") and not math.isnan(value := float(row[name])):
            yield value, row


def _outside_data(rows: Sequence[Row]) -> str:
    """Samples outside the data that a learned model was fitted to, and flights for which that is not known."""
    shares = list(_known(rows, "outside_data"))
    known = {id(row) for _, row in shares}
    unknown = sum(bool(row.get("model")) and row["outcome"] not in UNFLOWN and id(row) not in known for row in rows)
    parts = [f"unknown of {unknown} flights whether inside the data of its model (older checkpoint)"] if unknown else []
    largest, row = max(shares, key=itemgetter(0), default=(0.0, {}))
    if largest > REPORTED_SHARE:
        mean = sum(share for share, _ in shares) / len(shares)
        where = f"longest {row['outside_where']}" if row.get("outside_where") else ""
        most = f"most: {100 * largest:.3g} %, {_place(row)}" if len(shares) > 1 else ""
        said = "; ".join(filter(None, (most, where)))
        parts.insert(
            0, f"{100 * mean:.3g} % of samples outside the data its model was fitted to{f' ({said})' if said else ''}"
        )
    return "; ".join(parts)


def _reference_residual(rows: Sequence[Row]) -> str:
    """References that contain the residual only in part, or not at all."""
    known = [value for value, _ in _known(rows, "reference_residual")]
    partly, without = sum(0 < value < 1 for value in known), sum(value <= 0 for value in known)
    parts = [f"{partly} of {len(known)} references contain the residual only in part"] if partly else []
    parts += [f"{without} of {len(known)} references do not contain the residual"] if without else []
    return ", ".join(parts)


def _unknown_world(rows: Sequence[Row]) -> str:
    """Worlds of which a controller that is given the plant's equations knows nothing."""
    worlds = sorted({row["plant"].partition("/")[2] for row in rows if is_bound(row["controller"])} - {""})
    return f"knows the plant's equations, and nothing of the world around it ({'; '.join(worlds)})" if worlds else ""


def _heading_error(rows: Sequence[Row]) -> str:
    """Large heading errors of completed flights. The tilt is what path and air demand; where it is not, the position
    shows it."""
    errors = [(error, row) for error, row in _known(rows, "heading_rmse") if row["outcome"] == "ok"]
    worst, row = max(errors, key=itemgetter(0), default=(0.0, {}))
    large = sum(error > LARGE_HEADING_ERROR for error, _ in errors)
    if not large:
        return ""
    above = f"heading error above {math.degrees(LARGE_HEADING_ERROR):.0f} degrees in {large}"
    return f"{above} of {count(len(errors), 'flight')} (most: {math.degrees(worst):.3g} degrees, {_place(row)})"


def restless(flights: Mapping[Contestant, Sequence[Row]], labels: Mapping[Contestant, str]) -> list[str]:
    """Contestants with remedies=auto whose commands change, or that use the battery, more than RESTLESS times as much
    as without, in the median of the flights that both flew."""
    lines = []
    for who, without in _with_auto(flights):
        for name, what in (("command_change", "commands change"), ("charge_used", "the battery is used")):
            before = {(condition_of(row), row["seed"]): value for value, row in _known(flights[without], name)}
            pairs = [(value, before.get((condition_of(row), row["seed"]))) for value, row in _known(flights[who], name)]
            ratios = [value / other for value, other in pairs if other]
            if ratios and (ratio := median(ratios)) > RESTLESS:
                pairs_text = f"in the median of {count(len(ratios), 'pair')}"
                lines.append(f"{labels[who]}: {what} {ratio:.2g} times as much as of {labels[without]}, {pairs_text}")
    return lines


def _with_auto(contestants: Iterable[Contestant]) -> Iterator[tuple[Contestant, Contestant]]:
    """Each with remedies=auto, and the one that differs from it in nothing but that."""
    others = {}
    for who in contestants:
        settings = dict(setting_pairs(who.settings))
        remedies = settings.pop("remedies", "none")
        others[who.controller, who.model, remedies, frozenset(settings.items())] = who
    for (controller, model, remedies, beside), who in others.items():
        without = others.get((controller, model, "none", beside))
        if remedies == "auto" and without is not None:
            yield who, without


OF_A_CONTESTANT: tuple[Callable[[Sequence[Row]], str], ...] = (
    _outside_data, _reference_residual, _unknown_world, _heading_error,
)  # fmt: skip


def _place(row: Row) -> str:
    at = condition_of(row)
    return " ".join(part for part in (at.trajectory, speed_text(at.speed), at.setting) if part)


def outside_line(record: Mapping[str, Any] | None, *, always: bool = False) -> list[str]:
    """A line if more than REPORTED_SHARE of a flight lay outside its model's data, or that is unknown; or always."""
    if record is None:
        return []
    share, model = record["share"], record["model"]
    if share is None:
        return [f"data        unknown whether the flight lay inside the data of {model}: {record['note']}"]
    if share <= REPORTED_SHARE and not always:
        return []
    worst = sorted(record["shares"].items(), key=lambda feature: -feature[1])[:3]
    parts = [
        f"{name} {100 * outside:.1f} %, fitted on {_range(name, record['ranges'][name])}"
        for name, outside in worst
        if outside > 0
    ] + [f"longest {where}" for where in [record.get("where")] if where]
    of = f" ({'; '.join(parts)})" if parts else ""
    return [f"data        {100 * share:.1f} % of samples outside the data that {model} was fitted to{of}"]


def range_lines(ranges: Mapping[str, Sequence[float]]) -> list[str]:
    """The range of each feature in the data of a checkpoint, in one line."""
    if not ranges:
        return ["covers      unknown: fitted by an older version; fit it again"]
    return [f"covers      {', '.join(f'{name} {_range(name, ends)}' for name, ends in ranges.items())}; each by itself"]


def _range(name: str, ends: Sequence[float]) -> str:
    unit = UNITS.get(name, UNITS.get(name.partition("_")[0], ""))
    return f"{ends[0]:.3g} to {ends[1]:.3g} {unit}"
