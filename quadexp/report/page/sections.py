"""The page's tables as plain data for the template: scoreboard, errors, paired differences, worst flights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quadexp.log.schema import Flight
from quadexp.report.metrics import position_error
from quadexp.report.notes import table_notes
from quadexp.report.page.provenance import redo_command
from quadexp.report.page.source import KNOWS, TABLED, Comparison, Course, course_of, spoken
from quadexp.report.pairing import Condition, Flights, condition_of
from quadexp.report.statistics import Statistic
from quadexp.report.tables import TITLES, lost_text, own_text, value_text
from quadexp.report.text import duration, number, percent, probability, shown, speed_text, with_interval

WORST = 9
MOST_WORLDS = 30
WIDE = 6  # columns; with more, a table is printed across the sheet
EACH = 2  # flights of one contestant among the worst, of those that ended well
SPARK = 160, 36  # of an error trace, px
SPARK_POINTS = 120


def scoreboard(comparison: Comparison) -> list[dict[str, Any]]:
    """Every contestant in the main world: flights that ended well, error, difference to the baseline, computing time.

    Sorted by the share of flights that ended well, then by the error over the common flights.
    """
    factor, unit = shown(comparison.metric)
    means = {label: factor * comparison.geometric_mean(label) for label in comparison.order}
    known = [m for m in means.values() if m > 0]
    low, high = (math.log(min(known)), math.log(max(known))) if known else (0.0, 1.0)
    board = []
    for label in comparison.order:
        one, mean, flights = comparison.overall.get(label), means[label], comparison.success(label)
        beyond = flights.ended > (comparison.common.flights if mean == mean else 0)
        own = f"own {number(factor * comparison.geometric_mean(label, own=True))} of {flights.ended}" if beyond else ""
        change = _change(one.reduction, one.reduction_low, one.reduction_high) if one else ("", "")
        board.append(
            {
                "label": label,
                "knows": KNOWS.get(comparison.controllers[label], ""),
                "role": _role(comparison, label),
                "error": number(mean),
                "unit": unit,
                "own": own,
                "at": 4 + 92 * (math.log(mean) - low) / (high - low or 1.0) if mean > 0 else None,
                "change": change[0],
                "limits": change[1].strip(),
                "p": probability(one.p_holm) if one and one.testable else "",
                "median": duration(comparison.time(label)),
                "p99": duration(comparison.time(label, "p99")),
                "ended": flights.text(),
                "complete": flights.ended == flights.trials,
            }
        )
    return board


def worlds(comparison: Comparison) -> dict[str, Any] | None:
    """Success and error of every contestant in each plant, vehicle and world; None where there is only one."""
    if len(comparison.worlds) < 2:
        return None
    factor, unit = shown(comparison.metric)
    lines, columns = [], list(comparison.look)
    for world in comparison.worlds[:MOST_WORLDS]:
        rows = [row for row in comparison.rows if (row["plant"], row["vehicle"]) == world]
        there = replace(comparison, rows=rows)
        labels = {comparison.labels[contestant]: label for contestant, label in there.labels.items()}
        cells = []
        for column in columns:
            label = labels.get(column)
            flights = there.success(label) if label else Flights(0, 0)
            mean = factor * there.geometric_mean(label) if label else math.nan
            ended = flights.text() if flights.trials else ""
            text = number(mean) if math.isfinite(mean) else ""
            cells.append({"ended": ended, "complete": flights.ended == flights.trials, "text": text})
        sample = next((f for row in rows if row["outcome"] == "ok" and (f := comparison.flight(row)) is not None), None)
        about = {"wind": "", "estimate": ""} if sample is None else _surroundings(sample)
        lines.append({"name": f"{world[0]}, {world[1]}", "cells": cells, **about})
    left = len(comparison.worlds) - len(lines)
    return {"columns": columns, "lines": lines, "unit": unit, "left": left, "wide": len(columns) > WIDE}


def _surroundings(flight: Flight) -> dict[str, str]:
    """Mean and largest wind of a flight, and how far its estimated position is off, in words."""
    found = {"wind": "", "estimate": ""}
    if flight.wind is not None and flight.wind.any():
        speed = np.linalg.norm(flight.wind, axis=1)
        found["wind"] = f"wind {speed.mean():.1f} m/s, most {speed.max():.1f} m/s"
    if "est_p_x" in flight.columns:
        off = flight.stack([f"est_p_{i}" for i in "xyz"]) - flight.stack([f"p_{i}" for i in "xyz"])
        if off.any():
            found["estimate"] = f"told {number(1e3 * float(np.sqrt((off**2).sum(axis=1).mean())))} mm off (rms)"
    return found


def _role(comparison: Comparison, label: str) -> str:
    if label == comparison.best and len(comparison.rivals) > 1:
        base, own = comparison.reference, comparison.geometric_mean(label)
        return "best" if base is None or not own > comparison.geometric_mean(base) else ""
    return "baseline" if label == comparison.reference else "bound" if label in comparison.bounds else ""


def _change(reduction: float, low: float = math.nan, high: float = math.nan) -> tuple[str, str]:
    """A reduction as a change, and its interval: a reduction by 98.6 % is -98.6 %."""
    if not math.isfinite(reduction):
        return "", ""
    text, limits = percent(-reduction, -high, -low)
    return text if text.startswith("-") else f"+{text}", limits


def tables(comparison: Comparison) -> list[dict[str, Any]]:
    """One table of means and one of paired differences for every metric, over common flights; the main metric first."""
    metrics = [comparison.metric, *(m for m in TABLED if m != comparison.metric)]
    return [_table(comparison, metric) for metric in metrics if comparison.select(metric)]


def _table(comparison: Comparison, metric: str) -> dict[str, Any]:
    statistics = comparison.select(metric)
    found = {(s.condition, comparison.labels[s.contestant]): s for s in statistics}
    flown: dict[str, Flights] = {}  # on all plants and vehicles
    for (_, label), s in found.items():
        flown[label] = flown.get(label, Flights(0, 0)).plus(s.flown)
    columns = [label for label in comparison.look if label in flown]
    order = list(dict.fromkeys(map(course_of, comparison.conditions)))
    conditions = sorted(
        comparison.conditions, key=lambda c: (order.index(course_of(c)), -1.0 if c[3] is None else c[3])
    )
    compared = [c for c in columns if any(s.baseline for (_, who), s in found.items() if who == c)]
    previous: list[Course | None] = [None, *map(course_of, conditions)]
    return {
        "metric": metric,
        "title": TITLES[metric],
        "unit": shown(metric)[1],
        "columns": [{"label": label, "flown": flown[label].text()} for label in columns],
        "compared": compared,
        "baseline": next((s.baseline for s in statistics if s.baseline), ""),
        "lines": [
            {
                "course": comparison.course_title(course_of(c)),
                "speed": speed_text(c[3], ""),
                "first": course_of(c) != before,
                "means": [_mean_cell(found.get((c, x))) for x in columns],
                "differences": [_difference_cell(found.get((c, x))) for x in compared],
            }
            for c, before in zip(conditions, previous, strict=False)
        ],
        "confidence": f"{statistics[0].confidence:.0%}",
        "notes": table_notes(statistics, ()),
        "wide": len(columns) > WIDE,
    }


def _mean_cell(s: Statistic | None) -> dict[str, Any]:
    if s is None:
        return {"text": "-"}
    (text, limits), lost = value_text(s), lost_text(s).replace("_", " ")
    star = "*" if s.significant and text else ""
    return {"text": text + star, "limits": limits.strip(), "own": own_text(s), "lost": lost, "best": s.best}


def _difference_cell(s: Statistic | None) -> dict[str, Any]:
    if s is None or not s.pairs:
        return {"text": "-", "left": s.left_out if s else ""}
    factor, _ = shown(s.metric)
    text, limits = with_interval(*(factor * v for v in (s.difference, s.difference_low, s.difference_high)))
    return {
        "text": text if s.difference < 0 else f"+{text}",
        "limits": limits.strip(),
        "change": _change(s.reduction)[0],
        "p": probability(s.p_holm) if s.testable else "",
        "left": s.left_out,
        "sure": s.significant,
    }


def worst_rows(comparison: Comparison, most: int = WORST) -> list[Mapping[str, Any]]:
    """Flights that did not end well, then the largest errors: the worst seed of each contestant and condition, at most
    EACH per contestant.
    """

    def badness(row: Mapping[str, Any]) -> tuple[Any, ...]:
        ended = ("failed", "solver_failed", "lost", "left_corridor", "infeasible", "ok")
        order = ended.index(row["outcome"]) if row["outcome"] in ended else 0
        error = row["max_error"]
        return order, -(error if error is not None and math.isfinite(error) else 0.0)

    chosen: list[Mapping[str, Any]] = []
    conditions: dict[str, list[Condition]] = {}
    for row in sorted(comparison.rows, key=badness):
        seen = conditions.setdefault(comparison.label(row), [])
        if row["outcome"] == "ok" and (condition_of(row) in seen or len(seen) >= EACH):
            continue
        seen.append(condition_of(row))
        chosen.append(row)
    return chosen[:most]


def worst(
    comparison: Comparison, rows: Sequence[Mapping[str, Any]], cases: Mapping[tuple[Any, ...], int]
) -> list[dict[str, Any]]:
    """The worst flights for the template. cases: (condition, seed) -> number in the replay."""
    from quadexp.report.page.replay import case_of

    made = []
    for row in rows:
        flight = comparison.flight(row)
        error = position_error(flight) if flight is not None and "ref_p_x" in flight.columns else None
        about = {"largest": "", "at": "", "spark": ""}
        if flight is not None and error is not None:
            at = int(np.argmax(error))
            where = "" if "thinned" in flight.metadata else f"{flight.t[at]:.1f}"
            about = {"largest": number(1e3 * row["max_error"]), "at": where, "spark": _spark(error)}
        made.append(
            {
                "label": comparison.label(row),
                "name": spoken(comparison.label(row)),
                "course": comparison.courses[row["trajectory"], condition_of(row)[4]],
                "speed": speed_text(row["speed"]),
                "seed": row["seed"],
                "world": f"{row['plant']}, {row['vehicle']}",
                "outcome": row["outcome"].replace("_", " "),
                "ok": row["outcome"] == "ok",
                "cause": row.get("cause") or "",
                "case": cases.get(case_of(row)),
                "command": redo_command(comparison.asked(row)),
                **about,
            }
        )
    return made


def _spark(error: np.ndarray) -> str:
    """The error over the flight as the points of a polyline, the largest of each bin, from zero up."""
    width, height = SPARK
    peaks = np.array([float(part.max()) for part in np.array_split(error, min(SPARK_POINTS, len(error)))])
    x = np.linspace(0, width, len(peaks))
    y = height - 1.5 - (height - 3) * peaks / (float(peaks.max()) or 1.0)
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
