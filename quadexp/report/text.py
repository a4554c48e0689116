"""Numbers, intervals and lists as text: one format for terminal, Markdown, LaTeX and the page.

All texts are ASCII; `typeset` sets them with the minus signs and fixed blanks of the page.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

from quadexp.report.metrics import metric_of

MOST_DECIMALS = 3  # of a percentage
SPACE, NOBREAK, MINUS, DASH = "\u202f", "\u00a0", "\u2212", "\u2013"  # SPACE: narrow, does not break
_MINUS = re.compile(r"(?<![\w.=/:-])-(?=\d)")
_UNIT = re.compile(r"(?<=\d) (?=(?:mm|m/s|ms|µs|s|%|°)(?![\w/]))")
_BRACKETS = re.compile(r"\[[^\[\]]*\d\]|\bp [<=] ")


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
    return "-" if not math.isfinite(value) else f"{value:.2e}" if 0 < abs(value) < 1e-5 else significant(value)


def with_interval(value: float, low: float = math.nan, high: float = math.nan) -> tuple[str, str]:
    """Such as ("240.6", " [239.9, 241.2]"): as many decimals as the interval needs; ("240.6", "") without one."""
    half = (high - low) / 2
    text = significant(value, max(1, -math.floor(math.log10(half))) if half > 0 and math.isfinite(half) else 1)
    if math.isnan(half):
        return text, ""
    decimals = len(text.partition(".")[2])
    return text, f" [{low:.{decimals}f}, {high:.{decimals}f}]"


def percent(value: float, low: float = math.nan, high: float = math.nan, *, least: int = 1) -> tuple[str, str]:
    """Such as ("98.6 %", " [98.5, 98.7]"); more decimals if the interval is narrow, or close to 100 % without one."""
    half = (high - low) / 2
    if not math.isfinite(value):
        return "-", ""
    if half > 0 and math.isfinite(half):
        decimals = min(max(1, -math.floor(math.log10(half))), MOST_DECIMALS)
        return f"{value:.{decimals}f} %", f" [{low:.{decimals}f}, {high:.{decimals}f}]"
    missing = abs(100 - abs(value))
    decimals = max(least, 1 - math.floor(math.log10(missing))) if 0 < missing < 0.5 else least
    return f"{value:.{min(decimals, 4)}f} %", ""


def plain(value: Any) -> str:
    """A value of a setting: "" for None, true and false in small letters, floats without superfluous digits."""
    if value is None:
        return ""
    return str(value).lower() if isinstance(value, bool) else f"{value:.6g}" if isinstance(value, float) else str(value)


def relative(value: float) -> str:
    """Such as "-99.1 %", "same", or "-" for NaN."""
    return "-" if math.isnan(value) else "same" if value == 0 else f"{value:+.3g} %"


def p_value(p: float) -> str:
    """Such as "0.031", "< 0.0001", or "-" for NaN."""
    return "-" if math.isnan(p) else "< 0.0001" if p < 1e-4 else f"{p:.2g}"


def probability(p: float) -> str:
    """Such as "p = 0.031", "p < 0.0001", or "" for NaN."""
    return "" if math.isnan(p) else f"p {'' if p < 1e-4 else '= '}{p_value(p)}"


def too_few(seeds: int, least: int, confidence: float, over: str = "") -> str:
    """Of a test that so few seeds cannot pass. least: that could, see inference.least_seeds. over: how many tests."""
    if seeds < least:
        return f"{count(seeds, 'seed')} cannot show p < {1 - confidence:.2g}{over}: at least {least} are needed"
    return f"{count(seeds, 'seed')}, which change nothing: no test"


def duration(seconds: float, exact: bool = False) -> str:
    """A time in a suitable unit: 40.3 µs, 14.2 ms, 2.10 s. exact: without zeros at the end."""
    if not math.isfinite(seconds):
        return "-"
    factor, unit = (1.0, "s") if seconds >= 1 else (1e3, "ms") if 1e3 * seconds >= 1 else (1e6, "µs")
    value = factor * seconds
    return f"{value:g} {unit}" if exact else f"{value:.{0 if value >= 100 else 1 if value >= 10 else 2}f} {unit}"


def speed_text(speed: Any, unit: str = " m/s") -> str:
    """A nominal speed such as "8 m/s"; "" for a trajectory without one (None or NaN)."""
    return "" if speed is None or math.isnan(float(speed)) else f"{float(speed):g}{unit}"


def count(n: int, what: str) -> str:
    """Such as "1 flight" or "3 flights"."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def listed(words: Sequence[str], last: str = "and") -> str:
    """Such as "circle, lemniscate and hover"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}" if words else ""


def typeset(text: str) -> str:
    """The text with minus signs, dashes, narrow blanks before units, and no line breaks inside intervals."""
    text = _BRACKETS.sub(lambda match: match[0].replace(" ", NOBREAK), _UNIT.sub(SPACE, _MINUS.sub(MINUS, text)))
    return DASH if text == "-" else text
