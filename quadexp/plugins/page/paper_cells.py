"""A cell of a table for a paper: a mean, its interval in one of three forms, and how many flights were completed.

12.3    12.3 ± 0.2    12.3 [12.1, 12.5]    **12.3** (best)    12.3* (significant)    12.3 (4/5)    0/5
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

from quadexp.plugins.page.places import Point
from quadexp.report.pairing import Rows
from quadexp.report.statistics import Statistic
from quadexp.report.table import Table
from quadexp.report.tables import error_table
from quadexp.report.text import shown, with_interval

Intervals = Literal["none", "pm", "brackets"]


def number_text(
    mean: float, low: float, high: float, intervals: Intervals, digits: int | None = None
) -> tuple[str, str]:
    """A mean and its interval: ("12.3", ""), ("12.3", " ± 0.2") or ("12.3", " [12.1, 12.5]").

    digits: significant ones of the mean; None for as many as the interval needs, or three."""
    there = intervals != "none" and math.isfinite(high - low)
    text, _ = with_interval(mean, low, high) if there else with_interval(mean)
    if digits is not None:
        first = math.floor(math.log10(abs(mean))) if mean else 0
        text = f"{mean:.{max(0, digits - 1 - first)}f}"
    if not there:
        return text, ""
    decimals = len(text.partition(".")[2])
    if intervals == "pm":
        return text, f" ± {high - mean:.{decimals}f}"
    return text, f" [{low:.{decimals}f}, {high:.{decimals}f}]"


def cell_text(
    factor: float, point: Point, statistic: Statistic | None, intervals: Intervals, digits: int | None
) -> str:
    """Such as "**12.3** ± 0.2* (4/5)": best, significant, 4 of 5 flights completed."""
    if point.invalid:
        return "invalid"
    ended = f"{point.ended}/{point.trials}"
    if not point.is_shown:
        return ended if point.trials else "-"
    text, interval = number_text(factor * point.mean, factor * point.low, factor * point.high, intervals, digits)
    if statistic is not None and statistic.best:
        text = f"**{text}**"
    star = "*" if statistic is not None and statistic.significant else ""
    lost = f" ({ended})" if point.ended < point.trials else ""
    return text + interval + star + lost


def compact_table(
    rows: Rows, metric: str, baseline: str, confidence: float, intervals: Intervals, digits: int | None = None
) -> Table:
    """The error table of a metric with such cells, which say themselves how many flights were completed."""
    factor = shown(metric)[0]

    def cell(s: Statistic) -> str:
        ended, trials = s.flown
        point = Point(s.common_mean, s.common_low, s.common_high, ended=ended, trials=trials)
        return cell_text(factor, point, s, intervals, digits)

    table = error_table(rows, metric, baseline=baseline, confidence=confidence, cell=cell)
    return replace(table, rows=table.rows[table.head :], head=0)
