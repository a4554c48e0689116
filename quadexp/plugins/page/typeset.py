"""Numbers as the page has them: percentages, times, and signs set as in print."""

from __future__ import annotations

import math
import re

MOST_DECIMALS = 3  # of a percentage
SPACE, NOBREAK, MINUS, DASH = "\u202f", "\u00a0", "\u2212", "\u2013"  # SPACE: narrow, does not break
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
    return "-" if math.isnan(value) else "same" if value == 0 else f"{value:+.3g} %"


def duration(seconds: float, exact: bool = False) -> str:
    """A time in a suitable unit: 40.3 µs, 14.2 ms, 2.10 s. exact: without zeros at the end."""
    if not math.isfinite(seconds):
        return "-"
    factor, unit = (1.0, "s") if seconds >= 1 else (1e3, "ms") if 1e3 * seconds >= 1 else (1e6, "µs")
    value = factor * seconds
    return f"{value:g} {unit}" if exact else f"{value:.{0 if value >= 100 else 1 if value >= 10 else 2}f} {unit}"


def typeset(text: str) -> str:
    """The text with minus signs, dashes, narrow blanks before units, and no line breaks inside intervals."""
    text = _BRACKETS.sub(lambda match: match[0].replace(" ", NOBREAK), _UNIT.sub(SPACE, _MINUS.sub(MINUS, text)))
    return DASH if text == "-" else text
