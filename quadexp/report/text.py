"""Numbers, intervals and lists as text, in ASCII: one format for terminal, Markdown and LaTeX."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from quadexp.report.metrics import metric_of


def shown(metric: str) -> tuple[float, str]:
    """Factor from SI and unit in which a metric is printed."""
    known = metric_of(metric)
    return known.factor, known.unit


def significant(value: float, least: int = 1) -> str:
    """Three significant digits or one decimal, whichever has more digits: 0.0123, 1.23, 12.3, 123.4.

    least: number of decimals."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    return f"{value:.{max(least, 2 - math.floor(math.log10(abs(value))))}f}"


def number(value: float) -> str:
    """As `significant`, but tiny values with a power of ten, and "-" for NaN."""
    if not math.isfinite(value):
        return "-"
    return f"{value:.2e}" if 0 < abs(value) < 1e-5 else significant(value)


def with_interval(value: float, low: float = math.nan, high: float = math.nan) -> tuple[str, str]:
    """Such as ("240.6", " [239.9, 241.2]"): as many decimals as the interval needs; ("240.6", "") without one."""
    half = (high - low) / 2
    text = significant(value, max(1, -math.floor(math.log10(half))) if half > 0 and math.isfinite(half) else 1)
    if math.isnan(half):
        return text, ""
    decimals = len(text.partition(".")[2])
    return text, f" [{low:.{decimals}f}, {high:.{decimals}f}]"


def plain(value: Any) -> str:
    """A value of a setting: "" for None, true and false in small letters, floats without superfluous digits."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value).lower() if isinstance(value, bool) else str(value)


def p_value(p: float) -> str:
    """Such as "0.031", "< 0.0001", or "-" for NaN."""
    if math.isnan(p):
        return "-"
    return "< 0.0001" if p < 1e-4 else f"{p:.2g}"


def probability(p: float) -> str:
    """Such as "p = 0.031", "p < 0.0001", or "" for NaN."""
    return "" if math.isnan(p) else f"p {'' if p < 1e-4 else '= '}{p_value(p)}"


def too_few(seeds: int, least: int, confidence: float, over: str = "") -> str:
    """Of a test that so few seeds cannot pass. least: that could, see inference.least_seeds. over: how many tests."""
    if seeds < least:
        return f"{count(seeds, 'seed')} cannot show p < {1 - confidence:.2g}{over}: at least {least} are needed"
    return f"{count(seeds, 'seed')}, which change nothing: no test"


def speed_text(speed: Any, unit: str = " m/s") -> str:
    """A nominal speed such as "8 m/s"; "" for a trajectory without one (None or NaN)."""
    return "" if speed is None or math.isnan(float(speed)) else f"{float(speed):g}{unit}"


def count(n: int, what: str) -> str:
    """Such as "1 flight" or "3 flights"."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def listed(words: Sequence[str], last: str = "and") -> str:
    """Such as "circle, lemniscate and hover"."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"
