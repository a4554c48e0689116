"""The question and its answer, made from the numbers: who flew, what is gained, who is best, and real time.

A gain is credited to knowing the aerodynamics only between controllers that differ in nothing else (source.AIR).

Success comes first. Errors are over the common flights (report/pairing.py). A best contestant is named only if it
differs significantly from every other one and nobody flew more (report/winner.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from quadexp.report.page.source import Comparison, spoken
from quadexp.report.tables import TITLES
from quadexp.report.text import count, duration, listed, number, percent, probability, shown, span, typeset

QUESTION = (
    "How much does knowing the aerodynamics buy, which way of knowing it is best, and does it still run in real time?"
)
MOST_COUNTS = 6  # of "k of n" in the headline
MOST_NAMES = 4  # of controllers with the same count
VERY_SURE = 0.001  # probability that chance alone makes such a difference
WHICH = "Which controller tracks best, by how much, and does it still run in real time?"
ALONE = "How closely does it track, and does it run in real time?"


@dataclass(frozen=True)
class Answer:
    """question; flown, gain, in_time: parts of the answer; sure: how far it can be trusted, in plain words; note: the
    data behind it."""

    question: str
    flown: str
    gain: str
    in_time: str
    sure: str
    note: str

    @property
    def sentences(self) -> tuple[str, str]:
        """Who flew and what is gained; whether it runs in real time."""
        return f"{self.flown} {self.gain}".strip(), self.in_time


def answer(comparison: Comparison) -> Answer:
    """The answer for any results: with or without a baseline, a winner, or a flight that ended well."""
    question = ALONE if len(comparison.order) < 2 else QUESTION if comparison.of_the_air else WHICH
    gain = _capital(_gain(comparison))
    parts = (_flown(comparison), gain, _in_time(comparison), _sure(comparison), _note(comparison))
    return Answer(question, *map(typeset, parts))


def _flown(comparison: Comparison) -> str:
    """How many flights of each controller ended well."""
    counts = {label: comparison.success(label) for label in comparison.order}
    trials = sum(one.trials for one in counts.values())
    if all(one.ended == one.trials for one in counts.values()):
        return f"All {trials} flights ended well." if trials > 1 else "The flight ended well." if trials else ""
    groups: dict[str, list[str]] = {}
    for label, one in counts.items():
        groups.setdefault(one.text(), []).append(spoken(label))
    parts = [
        f"{listed(names) if len(names) <= MOST_NAMES else f'{len(names)} controllers'} {text}"
        for text, names in groups.items()
    ]
    if len(parts) > MOST_COUNTS:
        parts = [*parts[: MOST_COUNTS - 1], f"{len(parts) - MOST_COUNTS} more counts in the table", parts[-1]]
    return f"Flights that ended well: {', '.join(parts)}."


def _error(comparison: Comparison, label: str) -> str:
    factor, unit = shown(comparison.metric)
    return f"{number(factor * comparison.geometric_mean(label))} {unit}"


def _gain(comparison: Comparison) -> str:
    lead, base = comparison.lead, comparison.reference
    metric = TITLES.get(comparison.metric, comparison.metric)
    compared = comparison.compared
    if not compared:
        if any(comparison.success(label).ended for label in comparison.order):
            return "no two of them ended the same flight well, so there is no error to compare."
        return "no flight ended well, so there is no error to compare."
    over = _over(comparison)
    if lead is None:
        errors = [f"{spoken(label)} {_error(comparison, label)}" for label in compared]
        if len(compared) == 1:
            return f"{over}{spoken(compared[0])} keeps a {metric} of {_error(comparison, compared[0])}."
        return f"{over}the {metric} is {listed(errors)}."
    rest = f"{_bound(comparison)}{_flew_more(comparison)}"
    if base is None or base not in compared:
        error = _error(comparison, lead)
        return f"{over}{spoken(lead)}{_standing(comparison)} has a {metric} of {error}{rest}."
    ratio, p = comparison.to_base
    both = f"{_error(comparison, lead)} against {_error(comparison, base)}"
    less = ratio.value <= 1
    reduction = "".join(_apart(*ratio[:3]))
    if not p < 1 - comparison.confidence:
        chance = probability(p) if math.isfinite(p) else "so few flights cannot tell"
        return (
            f"{over}{spoken(lead)}{_standing(comparison)} is not distinguishable from {spoken(base)}: its {metric} is"
            f" {reduction} {'smaller' if less else 'larger'} ({both}; {chance}){rest}."
        )
    if not less:
        nothing = "knowing the aerodynamics buys nothing: " if comparison.of_the_air else ""
        return (
            f"{over}{nothing}{spoken(lead)}{_standing(comparison)} has a {metric} {reduction} larger than"
            f" {spoken(base)} ({both})."
        )
    closer = f"tracks {1 / ratio.value:.3g} times closer than {spoken(base)} ({both}){rest}"
    if comparison.of_the_air:
        return (
            f"{over}knowing the aerodynamics cuts the {metric} by {reduction}: {spoken(lead)}{_standing(comparison)}"
            f" {closer}."
        )
    return f"{over}{spoken(lead)}{_standing(comparison)} {closer}: its {metric} is {reduction} smaller."


def _apart(value: float, low: float, high: float) -> tuple[str, str]:
    """How far a ratio is from one, and its interval, as percentages: 1.05 and 0.95 are "5.0 %"."""
    sign = 100 if value > 1 else -100
    ends = sorted((sign * (low - 1), sign * (high - 1)))
    return percent(abs(sign * (value - 1)), *ends)


def _over(comparison: Comparison) -> str:
    """The flights that errors are compared over, if these are not all."""
    flights = [comparison.success(label) for label in comparison.order]
    if len(flights) == 1 or all(one.ended == max(f.trials for f in flights) for one in flights):
        return ""
    names = [comparison.labels[one] for one in comparison.common.compared]
    who = "all" if len(names) == len(comparison.order) else listed([spoken(name) for name in names])
    return f"over the {count(comparison.common.flights, 'flight')} that {who} ended well, " if len(names) > 1 else ""


def _standing(comparison: Comparison) -> str:
    """The place of the lead among the ways, as a clause between commas."""
    ways = len([x for x in comparison.rivals if x in comparison.compared])
    if len(comparison.rivals) == 1:
        return ", the one way tried," if comparison.reference or comparison.bounds else ""
    clauses = []
    if comparison.alike:
        alike = [spoken(x) for x in comparison.alike]
        clauses.append(f"the least of {ways} but not distinguishable from {listed(alike, 'or')}")
    if comparison.flew_more and comparison.lead:
        least = "with" if clauses else "with the least of these errors but"
        clauses.append(f"{least} only {comparison.success(comparison.lead).text()} flights that ended well")
    if not clauses:
        clauses = [f"the best of {ways} ways" if ways > 1 else "the one way compared"]
    return f", {' and '.join(clauses)},"


def _flew_more(comparison: Comparison) -> str:
    """The least error among the rivals that flew more than the lead."""
    errors = {x: comparison.geometric_mean(x) for x in comparison.flew_more if x in comparison.rivals}
    least = min((x for x in errors if math.isfinite(errors[x])), key=lambda x: errors[x], default=None)
    if least is None:
        return ""
    return f"; of the ways that ended more flights well, {spoken(least)} has the least ({_error(comparison, least)})"


def _bound(comparison: Comparison) -> str:
    """The ratio of the lead's error to that of perfect knowledge, with its interval."""
    good = [x for x in comparison.bounds if x in comparison.compared]
    if not good or comparison.lead is None:
        return ""
    name, (value, low, high, p) = spoken(good[0]), comparison.to_bound(good[0])
    if not math.isfinite(value):
        return ""
    if not math.isfinite(low):
        return f"; {name} reaches {_error(comparison, good[0])}, which so few flights cannot tell from it"
    limits = f"[{low:.3g}, {high:.3g}]"
    if not p < 1 - comparison.confidence:
        return f", not distinguishable from {name} ({value:.3g} times its error {limits})"
    if value > 2:
        return f"; {name} reaches {_error(comparison, good[0])}, {value:.3g} times less {limits}"
    text = "".join(_apart(value, low, high))
    return f", {text} closer than {name}" if value < 1 else f", and comes within {text} of {name}"


def _in_time(comparison: Comparison) -> str:
    label = comparison.lead or next(iter(comparison.order), None)
    if label is None or not math.isfinite(comparison.time(label)):
        return "No control step was timed."
    median, tail, period = comparison.time(label), comparison.time(label, "p99"), comparison.period(label)
    base = comparison.reference
    beside = f"; {spoken(base)}: {duration(comparison.time(base))}" if base and base != label else ""
    step = f"the control step of {spoken(label)} takes {duration(median)} (median{beside})"
    if not math.isfinite(period):
        return f"{_capital(step)} and {duration(tail)} at the 99th percentile."
    due = f"of the {duration(period, exact=True)} between two commands"
    if tail <= period:
        return f"It runs in real time: {step} and {duration(tail)} at the 99th percentile, {due}."
    if median <= period:
        return f"It runs in real time in the median only: {step}, but {duration(tail)} at the 99th percentile, {due}."
    return f"It does not run in real time: {step}, {due}."


def _sure(comparison: Comparison) -> str:
    """How far the gain can be trusted: what chance alone would do, and what other seeds would show."""
    base, lead = comparison.reference, comparison.lead
    if lead is None or base is None or lead == base or base not in comparison.compared:
        flights = comparison.common.flights
        return f"How sure: {count(flights, 'flight')} each; nothing is compared with a baseline." if flights else ""
    one, (ratio, p) = comparison.overall[lead], comparison.to_base
    if not math.isfinite(p):
        few = f"{count(one.units, 'seed')} cannot tell chance from a difference"
        return f"How sure: not at all yet. {few}: fly more seeds."
    pairs = f"in {count(one.units, 'seed')}, both with the same noise"
    if p >= 1 - comparison.confidence:
        return (
            f"How sure: not sure. If {spoken(lead)} and {spoken(base)} were equally good, chance alone would make a"
            f" difference like this one {_odds(p)} ({pairs})."
        )
    seeds = ""
    if math.isfinite(ratio.low):
        low, high = sorted((100 * abs(1 - ratio.low), 100 * abs(1 - ratio.high)))
        ends = percent(low)[0], percent(high)[0]
        where = f"lie between {ends[0]} and {ends[1]}" if ends[0] != ends[1] else f"again be {ends[0]}"
        seeds = f" With other seeds the difference would {where}, {comparison.confidence:.0%} of the time."
    return (
        f"How sure: {'very' if p < VERY_SURE else 'fairly'}. If {spoken(lead)} and {spoken(base)} were equally good,"
        f" chance alone would make a difference like this one {_odds(p)} ({pairs}).{seeds}"
    )


def _odds(p: float) -> str:
    """A probability in words: "once in 2 000 times", "in 30 of 100 times"."""
    if p >= 0.095:
        return f"in {round(100 * p)} of 100 times"
    if p < 1e-6:
        return "less than once in a million times"
    size = 10 ** max(0, math.floor(math.log10(1 / p)) - 1)
    return f"once in {int(1 / p / size) * size:,} times".replace(",", " ")


def _note(comparison: Comparison) -> str:
    """What the answer is averaged over, and what is not in it."""
    conditions = [c for c in comparison.conditions if c[:2] == comparison.world]
    speeds = [c[3] for c in conditions if c[3] is not None]
    trajectories = list(dict.fromkeys(c[2] for c in conditions))
    seeds = {row["seed"] for row in comparison.main_rows}
    plant, vehicle = comparison.world
    flown = listed(trajectories) + (f" at {span(speeds, 'm/s')}" if speeds else "")
    each = f", {comparison.common.flights} flights each" if comparison.common.flights else ""
    parts = [f"Geometric means over {flown}, {count(len(seeds), 'seed')}{each}, plant {plant}, vehicle {vehicle}."]
    if comparison.lead is not None and comparison.reference is not None:
        ratio, p = comparison.to_base
        if math.isfinite(ratio.low) and math.isfinite(p):
            parts.append(
                f"{comparison.confidence:.0%} intervals; against the baseline {probability(p)}"
                f" (paired permutation test, by Holm over {count(len(comparison.overall), 'comparison')})."
            )
    if len(comparison.worlds) > 1:
        parts.append("Other plants and vehicles are in the tables.")
    bad = [row for row in comparison.main_rows if row["outcome"] != "ok"]
    total = len(comparison.main_rows)
    kinds = list(dict.fromkeys(row["outcome"].replace("_", " ") for row in bad))
    if comparison.best is not None and comparison.ranking.ratios:
        chance = probability(comparison.ranking.p)
        ways = len(comparison.ranking.ratios) + 1
        parts.append(f"Best of {ways}: {chance} (t test of the logarithms, corrected for the choice).")
    left = [spoken(x) for x in comparison.order if x not in comparison.compared]
    if left and comparison.common.flights:
        parts.append(f"Not compared, because too few flights ended well: {listed(left)}.")
    parts.append(
        f"{len(bad)} of {total} flights did not end well ({listed(kinds)})."
        if bad
        else f"All {total} flights ended well."
    )
    return " ".join(parts)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
