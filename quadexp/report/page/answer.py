"""The question, and its answer in two sentences made from the numbers: what it buys and who is best; is it in time."""

from __future__ import annotations

import math
from dataclasses import dataclass

from quadexp.report.overall import Overall
from quadexp.report.page.names import spoken
from quadexp.report.page.numbers import (
    SPACE,
    duration,
    listed,
    number,
    percent,
    percent_with_interval,
    probability,
    shown,
    span,
    times,
)
from quadexp.report.page.source import Comparison
from quadexp.report.tables import TITLES
from quadexp.report.wording import attitude_notes

QUESTION = (
    "How much does knowing the aerodynamics buy, which way of knowing it is best, and does it still run in real time?"
)
ALONE = "How closely does it track, and does it run in real time?"


@dataclass(frozen=True)
class Answer:
    """question; sentences: what it buys, and whether it is in time; note: what the sentences rest on."""

    question: str
    sentences: tuple[str, str]
    note: str


def answer(comparison: Comparison) -> Answer:
    """What the numbers say, for any results: with or without a baseline, a winner, or a flight that ended well."""
    question = QUESTION if len(comparison.order) > 1 else ALONE
    return Answer(question, (_gain(comparison), _in_time(comparison)), _note(comparison))


def _error(comparison: Comparison, label: str) -> str:
    factor, unit = shown(comparison.metric)
    return f"{number(factor * comparison.geometric_mean(label))}{SPACE}{unit}"


def _gain(comparison: Comparison) -> str:
    best, base = comparison.best, comparison.reference
    metric = TITLES.get(comparison.metric, comparison.metric)
    if best is None:
        alone = next((x for x in comparison.order if math.isfinite(comparison.geometric_mean(x))), None)
        if alone is None:
            return "No flight ended well, so there is no error to compare."
        return f"{_capital(spoken(alone))} keeps a {metric} of {_error(comparison, alone)}."
    one = comparison.overall.get(best)
    if base is None or one is None or not math.isfinite(one.reduction):
        return (
            f"{_capital(spoken(best))} tracks best, with a {metric} of {_error(comparison, best)}{_bound(comparison)}."
        )
    if one.reduction <= 0:
        return (
            f"Knowing the aerodynamics buys nothing here: the best way, {spoken(best)}, has a {metric}"
            f" {percent(-one.reduction)} larger than {spoken(base)}"
            f" ({_error(comparison, best)} against {_error(comparison, base)}){_chance(one)}."
        )
    ratio = 1 / (1 - one.reduction / 100)
    rivals = [x for x in comparison.order if x not in comparison.bounds and x != base]
    among = f"the best of {len(rivals)} ways" if len(rivals) > 1 else "the one way tried"
    reduction, limits = percent_with_interval(one.reduction, one.reduction_low, one.reduction_high)
    said = (
        f"Knowing the aerodynamics cuts the {metric} by {reduction}{f' {limits}' if limits else ''}:"
        f" {spoken(best)}, {among}, tracks {times(ratio)} times closer than {spoken(base)}"
        f" ({_error(comparison, best)} against {_error(comparison, base)}){_bound(comparison)}"
    )
    return f"{said}{_chance(one)}."


def _chance(one: Overall) -> str:
    """What to add where the difference may be none."""
    if not math.isfinite(one.p_holm) or one.significant:
        return ""
    return f", though so few flights cannot rule out chance ({probability(one.p_holm)})"


def _bound(comparison: Comparison) -> str:
    """How near the best comes to what perfect knowledge would give."""
    good = [x for x in comparison.bounds if math.isfinite(comparison.geometric_mean(x))]
    if not good or comparison.best is None:
        return ""
    ratio = comparison.geometric_mean(comparison.best) / comparison.geometric_mean(good[0])
    if ratio <= 1.005:
        return f", as close as {spoken(good[0])}"
    if ratio < 2:
        return f", and comes within {percent(100 * (ratio - 1), 0)} of {spoken(good[0])}"
    return f"; {spoken(good[0])} reaches {_error(comparison, good[0])}"


def _in_time(comparison: Comparison) -> str:
    label = comparison.best or next(iter(comparison.order), None)
    if label is None or not math.isfinite(comparison.time(label)):
        return "No step of a controller was timed."
    median, tail, period = comparison.time(label), comparison.time(label, "p99"), comparison.period(label)
    base = comparison.reference
    beside = f"; {spoken(base)}: {duration(comparison.time(base))}" if base and base != label else ""
    step = f"its control step takes {duration(median)} (median{beside})"
    if not math.isfinite(period):
        return f"{_capital(step)} and {duration(tail)} at the 99th percentile."
    due = f"of the {duration(period, exact=True)} between two commands"
    if tail <= period:
        return f"It runs in real time: {step} and {duration(tail)} at the 99th percentile, {due}."
    if median <= period:
        return f"It runs in real time in the median only: {step}, but {duration(tail)} at the 99th percentile, {due}."
    return f"It does not run in real time: {step}, {due}."


def _note(comparison: Comparison) -> str:
    """Over what the answer is averaged, and what is not in it."""
    conditions = [c for c in comparison.conditions if c[:2] == comparison.world]
    speeds = [c[3] for c in conditions if c[3] is not None]
    trajectories = list(dict.fromkeys(c[2] for c in conditions))
    seeds = {row["seed"] for row in comparison.main_rows}
    plant, vehicle = comparison.world
    flown = listed(trajectories) + (f" at {span(speeds, 'm/s')}" if speeds else "")
    count = f"{len(seeds)} seed{'s' if len(seeds) > 1 else ''}"
    parts = [f"Geometric means over {flown}, {count}, plant {plant}, vehicle {vehicle}."]
    one = comparison.overall.get(comparison.best or "")
    if one is not None and one.pairs:
        p = probability(one.p_holm)
        corrected = f", {p} corrected by Holm" if p else ""
        parts.append(f"{comparison.confidence:.0%} interval over {one.pairs} paired flights{corrected}.")
    if len(comparison.worlds) > 1:
        parts.append("Other plants and vehicles stand in the tables.")
    parts += [f"{_capital(line)}." for line in attitude_notes(comparison.select("attitude_rmse"))]
    bad = [row for row in comparison.main_rows if row["outcome"] != "ok"]
    total = len(comparison.main_rows)
    kinds = list(dict.fromkeys(row["outcome"].replace("_", " ") for row in bad))
    parts.append(
        f"{len(bad)} of {total} flights did not end well ({listed(kinds)})."
        if bad
        else f"All {total} flights ended well."
    )
    return " ".join(parts)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
