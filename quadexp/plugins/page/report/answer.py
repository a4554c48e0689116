"""The question and its answer, made from the numbers: who flew, what is gained, who is best, and real time.

The sentences on errors are those below the tables (winner.Verdict, statistics.Statistic), of every plant and vehicle;
what a gain is in the single conditions stands with it, and what was flown and takes no part is counted. A gain is
credited to knowing the aerodynamics only between controllers that differ in nothing else (source.AIR).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from quadexp.names import distinct
from quadexp.plugins.page.report.source import Comparison
from quadexp.plugins.page.typeset import duration, percent, typeset
from quadexp.report.metrics import metric_of
from quadexp.report.pairing import World, grouped
from quadexp.report.text import count, listed, number, shown

QUESTION = (
    "How much does knowing the aerodynamics buy, which way of knowing it is best, and does it still run in real time?"
)
WHICH = "Which controller tracks best, by how much, and does it still run in real time?"
ALONE = "How closely does it track, and does it run in real time?"
MOST_COUNTS = 6  # of "k of n" in the headline
VERY_SURE = 0.001  # probability that chance alone makes such a difference


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
    """The answer for any results: with or without a baseline, a winner, or a completed flight."""
    question = QUESTION if comparison.of_the_air else WHICH
    if len(comparison.order) < 2:
        question = ALONE
    parts = (_flown(comparison), _gain(comparison), _in_time(comparison), _sure(comparison), _note(comparison))
    return Answer(question, *map(typeset, parts))


def _flown(comparison: Comparison) -> str:
    """How many flights each controller completed, wherever it flew."""
    counts = {comparison.labels[who]: n for who, n in comparison.groups.flights(comparison.conditions).items()}
    counts = {label: counts[label] for label in comparison.look}
    trials = sum(flights.trials for flights in counts.values())
    if all(flights.ended == flights.trials for flights in counts.values()):
        if trials > 1:
            return f"All {trials} flights were completed."
        if trials:
            return "The flight was completed."
        return ""
    groups = grouped((flights.text(), label) for label, flights in counts.items())
    parts = [f"{listed(labels)} {text}" for text, labels in groups.items()]
    if len(parts) > MOST_COUNTS:
        parts = [*parts[: MOST_COUNTS - 1], f"{len(parts) - MOST_COUNTS} more counts in the table", parts[-1]]
    return f"Completed flights: {', '.join(parts)}."


def _gain(comparison: Comparison) -> str:
    """Who has the least error, against the baseline and against a bound."""
    verdict = comparison.verdict
    metric = metric_of(comparison.metric).title
    factor, unit = shown(comparison.metric)
    errors = {}
    for label in comparison.order:
        error = factor * comparison.geometric_mean(label)
        if math.isfinite(error):
            errors[label] = error
    if not errors:
        flew = any(comparison.success(label).ended for label in comparison.order)
        why = "No two of them completed the same flight" if flew else "No flight was completed"
        return f"{why}, so there is no error to compare."
    each = listed([f"{label} {number(error)} {unit}" for label, error in list(errors.items())[:MOST_COUNTS]])
    where = f" in {_world(comparison.world)}" if len(comparison.worlds) > 1 else ""
    sentences = [_capital(f"{metric}{where}: {each}."), *_verdicts(comparison), _against(comparison)]
    if verdict.of_bound is not None and math.isfinite(verdict.of_bound.ratio.value):
        ratio, low, high = verdict.of_bound.ratio
        limits = f" [{low:.3g}, {high:.3g}]" if math.isfinite(low) else ""
        alike = ", so they are not distinguishable" if verdict.of_bound.testable and not verdict.of_bound.apart else ""
        sentences.append(f"The error of {verdict.least} is {ratio:.3g} times{limits} that of {verdict.bound}{alike}.")
    return " ".join(filter(None, sentences))


def _verdicts(comparison: Comparison) -> list[str]:
    """Who has the least error in each plant and vehicle."""
    texts = []
    for verdict in comparison.verdicts.values():
        text = verdict.text()
        if text:
            texts.append(_capital(f"{text}."))
    hidden = len(texts) - MOST_COUNTS
    if hidden > 1:
        return [*texts[:MOST_COUNTS], f"{hidden} more of this kind are below the tables."]
    return texts


def _against(comparison: Comparison) -> str:
    """The gain of whom the answer compares with the baseline, in each plant and vehicle, the largest first where there
    are many; and the flights that are not in it."""
    ratios = {}
    for world, of in comparison.by_world.items():
        if comparison.rival in of:
            ratios[world] = of[comparison.rival]
    texts = {world: s for world, s in ratios.items() if s.pairs}
    if not texts:
        return ""
    credit = "Knowing the aerodynamics: " if comparison.of_the_air else ""
    if len(comparison.worlds) == 1:
        return f"{credit}{texts[comparison.world].text()}."
    shown = sorted(texts, key=lambda world: -texts[world].reduction)
    hidden = shown[MOST_COUNTS - 1 : -1] if len(shown) > MOST_COUNTS else []
    parts = [f"in {_world(world)}, {texts[world].text()}" for world in shown if world not in hidden]
    if hidden:
        parts.insert(-1, f"between these in {len(hidden)} more worlds")
    missing = [world for world in comparison.worlds if world not in texts]
    flights = sum((row["plant"], row["vehicle"]) in missing for row in comparison.rows)
    names = listed([_world(world) for world in missing[:MOST_COUNTS]])
    left_out = f" Not in it: {count(flights, 'flight')} in {names}, where they have no pair." if missing else ""
    return f"{_capital(credit + '; '.join(parts))}.{left_out}"


def _world(world: World) -> str:
    return " ".join(world)


def _in_time(comparison: Comparison) -> str:
    label = comparison.rival or next(iter(comparison.order), None)
    if label is None or not math.isfinite(comparison.time(label)):
        return "No control step was timed."
    median = comparison.time(label)
    tail = comparison.time(label, "p99")
    period = comparison.period(label)
    base = comparison.reference
    beside = f"; {base}: {duration(comparison.time(base))}" if base and base != label else ""
    step = f"the control step of {label} takes {duration(median)} (median{beside})"
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
    base = comparison.reference
    rival = comparison.rival
    pooled = comparison.overall.get(rival)
    if base is None or pooled is None or not pooled.pairs:
        flights = comparison.verdict.common
        return f"How sure: {count(flights, 'flight')} each; nothing is compared with a baseline." if flights else ""
    seeds = count(pooled.units, "seed")
    if not pooled.testable:
        return f"How sure: not at all yet. {seeds} cannot tell chance from a difference: fly more seeds."
    where = f" in {_world(comparison.world)}" if len(comparison.worlds) > 1 else ""
    unsure = []
    for w, of in comparison.by_world.items():
        if rival in of and not of[rival].significant:
            unsure.append(_world(w))
    others = f" It is not sure in {listed(unsure)}." if where and pooled.significant and unsure else ""
    chance = (
        f"If {rival} and {base} were equally good, chance alone would make a difference like this one"
        f" {odds(pooled.p_holm)} (in {seeds}{where}, both with the same noise)."
    )
    if not pooled.significant:
        return f"How sure: not sure. {chance}"
    ends = []
    for end in sorted((pooled.reduction_low, pooled.reduction_high), key=abs):
        ends.append(percent(abs(end))[0])
    limits = f"lie between {ends[0]} and {ends[1]}" if ends[0] != ends[1] else f"again be {ends[0]}"
    again = f"With other seeds the difference would {limits}, {comparison.confidence:.0%} of the time."
    return f"How sure: {'very' if pooled.p_holm < VERY_SURE else 'fairly'}. {chance} {again}{others}"


def odds(p: float) -> str:
    """A probability in words: "once in 2 000 times", "in 30 of 100 times"."""
    if p >= 0.095:
        return f"in {round(100 * p)} of 100 times"
    if p < 1e-6:
        return "less than once in a million times"
    size = 10 ** max(0, math.floor(math.log10(1 / p)) - 1)
    return f"once in {int(1 / p / size) * size:,} times".replace(",", " ")


def _note(comparison: Comparison) -> str:
    """What the answer is averaged over, and what is not in it."""
    verdict = comparison.verdict
    (plant, vehicle) = comparison.world
    conditions = sum(condition.world == comparison.world for condition in comparison.conditions)
    seeds = count(len({row["seed"] for row in comparison.main_rows}), "seed")
    each = f", {verdict.common} flights each" if verdict.common else ""
    over = f"{count(conditions, 'condition')}, {seeds}{each}, plant {plant}, vehicle {vehicle}"
    parts = [
        f"Geometric means over {over}; {comparison.confidence:.0%} intervals, p by a paired permutation test (Holm)."
    ]
    others = len(comparison.rows) - len(comparison.main_rows)
    if others:
        worlds = [_world(world) for world in comparison.by_world][1:]
        named = listed(worlds if len(worlds) <= MOST_COUNTS else [*worlds[:MOST_COUNTS], "others"])
        parts.append(f"Not in these means, and in their own sentences: {count(others, 'flight')} in {named}.")
    alone = [label for label in comparison.order if label not in verdict.compared]
    if alone and verdict.common:
        parts.append(f"Not compared, because they completed too few flights: {listed(alone)}.")
    bad = []
    for row in comparison.rows:
        if row["outcome"] != "ok":
            bad.append(row["outcome"].replace("_", " "))
    if bad:
        kinds = listed(distinct(bad))
        parts.append(f"{len(bad)} of {len(comparison.rows)} flights were not completed ({kinds}).")
    return " ".join(parts)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
