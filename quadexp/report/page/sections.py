"""The page's tables as plain data for the template: scoreboard, errors, paired differences, worst flights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quadexp.report.metrics import position_error
from quadexp.report.outside import outside_notes
from quadexp.report.page.figures import course_title
from quadexp.report.page.names import KNOWS, spoken
from quadexp.report.page.numbers import (
    MINUS,
    NOBREAK,
    alike,
    duration,
    interval,
    number,
    percent_with_interval,
    probability,
    shown,
)
from quadexp.report.page.source import TABLED, Comparison
from quadexp.report.pairing import Condition, condition_of
from quadexp.report.statistics import Statistic
from quadexp.report.tables import TITLES
from quadexp.report.wording import notes, with_interval

WORST = 9
EACH = 2  # flights of one contestant among the worst, of those that ended well
SPARK = 160, 36  # of an error trace, px
SPARK_POINTS = 120


def scoreboard(comparison: Comparison) -> list[dict[str, Any]]:
    """Everyone in the world of the answer, the best first: error, against the baseline, time, how flights ended."""
    factor, unit = shown(comparison.metric)
    means = {label: factor * comparison.geometric_mean(label) for label in comparison.order}
    known = [m for m in means.values() if m > 0]
    low, high = (math.log(min(known)), math.log(max(known))) if known else (0.0, 1.0)
    span = high - low or 1.0
    board = []
    for label in comparison.order:
        one, mean = comparison.overall.get(label), means[label]
        _, good, flown = comparison.success(label)
        board.append(
            {
                "label": label,
                "knows": KNOWS.get(comparison.controllers[label], ""),
                "role": _role(comparison, label),
                "error": number(mean),
                "unit": unit,
                "at": 4 + 92 * (math.log(mean) - low) / span if mean > 0 else None,
                "change": _change(one.reduction, one.reduction_low, one.reduction_high)[0] if one else "",
                "limits": _change(one.reduction, one.reduction_low, one.reduction_high)[1] if one else "",
                "p": probability(one.p_holm) if one else "",
                "median": duration(comparison.time(label)),
                "p99": duration(comparison.time(label, "p99")),
                "ended": f"{good} of {flown}",
                "complete": good == flown,
            }
        )
    return board


def _role(comparison: Comparison, label: str) -> str:
    if label == comparison.best:
        base = comparison.reference
        return "best" if base is None or not comparison.rank(label) > comparison.rank(base) else ""
    return "baseline" if label == comparison.reference else "bound" if label in comparison.bounds else ""


def _change(reduction: float, low: float = math.nan, high: float = math.nan) -> tuple[str, str]:
    """A reduction as a change, and its interval: 98.6 % less is −98.6 %."""
    if not math.isfinite(reduction):
        return "", ""
    text, limits = percent_with_interval(-reduction, -high, -low)
    return text if text.startswith(MINUS) else f"+{text}", limits


def tables(comparison: Comparison) -> list[dict[str, Any]]:
    """One table of means and one of paired differences for every metric; the deciding metric first."""
    metrics = [comparison.metric, *(m for m in TABLED if m != comparison.metric)]
    return [_table(comparison, metric) for metric in metrics if comparison.select(metric)]


def _table(comparison: Comparison, metric: str) -> dict[str, Any]:
    factor, unit = shown(metric)
    found = {(s.condition, comparison.labels[s.contestant]): s for s in comparison.select(metric)}
    columns = [label for label in comparison.look if any(label == who for _, who in found)]
    best = {condition: _best(comparison, found, condition) for condition in comparison.conditions}
    compared = [c for c in columns if any(s.baseline for (_, who), s in found.items() if who == c)]
    lines = [
        {
            "course": course_title(comparison, (c[0], c[1], c[2], c[4])),
            "speed": "" if c[3] is None else f"{c[3]:g}",
            "first": i == 0 or comparison.conditions[i - 1][:3] != c[:3],
            "means": [_mean_cell(found.get((c, x)), factor, best[c] == x) for x in columns],
            "differences": [_difference_cell(found.get((c, x)), factor) for x in compared],
        }
        for i, c in enumerate(comparison.conditions)
    ]
    some = next(iter(found.values()))
    baseline = next((s.baseline for s in found.values() if s.baseline), "")
    return {
        "metric": metric,
        "title": TITLES[metric],
        "unit": unit,
        "columns": columns,
        "compared": compared,
        "baseline": baseline,
        "lines": lines,
        "confidence": f"{some.confidence:.0%}",
        "notes": (*notes(list(found.values()), ()), *outside_notes(comparison.rows)),
    }


def _best(comparison: Comparison, found: Mapping[tuple[Condition, str], Statistic], condition: Condition) -> str | None:
    """The least mean among those with the highest success rate."""
    rivals = {who: s for (c, who), s in found.items() if c == condition and s.n}
    if len(rivals) < 2:
        return None
    most = max(s.success for s in rivals.values())
    return min((who for who in rivals if rivals[who].success == most), key=lambda who: rivals[who].mean)


def _mean_cell(s: Statistic | None, factor: float, best: bool) -> dict[str, Any]:
    if s is None:
        return {"text": "\u2013", "limits": "", "lost": "", "best": False}
    lost = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in s.failures.items())
    if not s.n:
        return {"text": "", "limits": "", "lost": lost, "best": False}
    text, limits = with_interval(factor * s.mean, factor * s.low, factor * s.high)
    star = "*" if s.significant else ""
    return {"text": text + star, "limits": limits.strip().replace(" ", NOBREAK), "lost": lost, "best": best}


def _difference_cell(s: Statistic | None, factor: float) -> dict[str, Any]:
    if s is None or not s.pairs:
        return {"text": "\u2013", "limits": "", "change": "", "p": "", "left": s.left_out if s else "", "sure": False}
    (text,) = alike([factor * s.difference])
    return {
        "text": text if s.difference < 0 else f"+{text}",
        "limits": interval(factor * s.difference_low, factor * s.difference_high, factor * s.difference),
        "change": _change(s.reduction)[0],
        "p": probability(s.p_holm) if s.comparisons * s.p_least < 1 - s.confidence else "",
        "left": s.left_out,
        "sure": s.significant,
    }


def worst_rows(comparison: Comparison, count: int = WORST) -> list[Mapping[str, Any]]:
    """Flights that did not end well, then the largest errors: of a contestant in one condition only the worst seed, and
    at most two conditions of each, so that the weakest of all does not fill the list.
    """

    def badness(row: Mapping[str, Any]) -> tuple[Any, ...]:
        ended = ("failed", "solver_failed", "lost", "infeasible", "ok")
        order = ended.index(row["outcome"]) if row["outcome"] in ended else 0
        error = row["max_error"]
        return order, -(error if error is not None and math.isfinite(error) else 0.0)

    chosen: list[Mapping[str, Any]] = []
    shown: dict[str, list[Condition]] = {}
    for row in sorted(comparison.rows, key=badness):
        seen = shown.setdefault(comparison.label(row), [])
        if row["outcome"] == "ok" and (condition_of(row) in seen or len(seen) >= EACH):
            continue
        seen.append(condition_of(row))
        chosen.append(row)
    return chosen[:count]


def worst(
    comparison: Comparison, rows: Sequence[Mapping[str, Any]], cases: Mapping[tuple[Any, ...], int]
) -> list[dict[str, Any]]:
    """Rows for the template. cases: (condition, seed) -> number in the replay."""
    from quadexp.report.page.provenance import redo_command
    from quadexp.report.page.replay import case_of

    made = []
    for row in rows:
        flight = comparison.flight(row)
        error = position_error(flight) if flight is not None and "ref_p_x" in flight.columns else None
        at = None if error is None else int(np.argmax(error))
        speed = row["speed"]
        made.append(
            {
                "label": comparison.label(row),
                "name": spoken(comparison.label(row)),
                "course": row["trajectory"],
                "speed": "" if speed is None or math.isnan(speed) else f"{speed:g} m/s",
                "seed": row["seed"],
                "world": f"{row['plant']}, {row['vehicle']}",
                "outcome": row["outcome"].replace("_", " "),
                "ok": row["outcome"] == "ok",
                "cause": row.get("cause") or "",
                "largest": "\u2013" if at is None or error is None else number(1e3 * float(error[at])),
                "at": "" if at is None or flight is None else f"{flight.t[at]:.1f}",
                "spark": "" if error is None else _spark(error),
                "case": cases.get(case_of(row)),
                "command": redo_command(comparison.asked(row)),
            }
        )
    return made


def _spark(error: np.ndarray) -> str:
    """The error over the flight as the points of a polyline, the largest of each bin, from zero up."""
    width, height = SPARK
    bins = np.array_split(error, min(SPARK_POINTS, len(error)))
    peaks = np.array([float(part.max()) for part in bins])
    top = float(peaks.max()) or 1.0
    x = np.linspace(0, width, len(peaks))
    y = height - 1.5 - (height - 3) * peaks / top
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
