"""Numbers as the page has them: percentages, times, and signs set as in print."""

from __future__ import annotations

import math
import re

MOST_DECIMALS = 3  # of a percentage
SPACE = "\u202f"  # narrow, does not break
NOBREAK = "\u00a0"
MINUS = "\u2212"
DASH = "\u2013"
_MINUS = re.compile(r"(?<![\w.=/:-])-(?=\d)")
_UNIT = re.compile(r"(?<=\d) (?=(?:mm|m/s|ms|µs|s|%|°)(?![\w/]))")
_BRACKETS = re.compile(r"\[[^\[\]]*\d\]|\bp [<=] ")


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


def relative(value: float) -> str:
    """Such as "-99.1 %", "same", or "-" for NaN."""
    if math.isnan(value):
        return "-"
    if value == 0:
        return "same"
    return f"{value:+.3g} %"


def duration(seconds: float, exact: bool = False) -> str:
    """A time in a suitable unit: 40.3 µs, 14.2 ms, 2.10 s. exact: without zeros at the end."""
    if not math.isfinite(seconds):
        return "-"
    value = 1e6 * seconds
    unit = "µs"
    if seconds >= 1:
        value = seconds
        unit = "s"
    elif 1e3 * seconds >= 1:
        value = 1e3 * seconds
        unit = "ms"
    if exact:
        return f"{value:g} {unit}"
    decimals = 2 - (value >= 10) - (value >= 100)
    return f"{value:.{decimals}f} {unit}"


def typeset(text: str) -> str:
    """The text with minus signs, dashes, narrow blanks before units, and no line breaks inside intervals."""
    if text == "-":
        return DASH
    text = _MINUS.sub(MINUS, text)
    text = _UNIT.sub(SPACE, text)
    return _BRACKETS.sub(lambda match: match[0].replace(" ", NOBREAK), text)
