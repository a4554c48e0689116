"""Numbers as they are read: digits that mean something, a unit, and an interval."""

from __future__ import annotations

import math

from quadexp.report.metrics import SHOWN
from quadexp.report.wording import significant

SPACE = "\u202f"  # narrow, does not break
MINUS = "\u2212"
NOBREAK = "\u00a0"


def shown(metric: str) -> tuple[float, str]:
    """Factor from SI and unit a metric is shown in."""
    return SHOWN.get(metric, (180 / math.pi, "°") if metric == "attitude_rmse" else (1.0, ""))


def number(value: float) -> str:
    """Three significant digits or one decimal; a dash where there is none."""
    return "\u2013" if not math.isfinite(value) else significant(value).replace("-", MINUS)


def alike(values: list[float]) -> list[str]:
    """A number and its interval, all with the decimals of the first."""
    first = values[0]
    if not math.isfinite(first):
        return ["\u2013"] * len(values)
    decimals = len(significant(first).partition(".")[2])
    return [f"{v:.{decimals}f}".replace("-", MINUS) if math.isfinite(v) else "\u2013" for v in values]


def interval(low: float, high: float, like: float) -> str:
    """Such as "[11.9, 12.8]" with the decimals of `like`; "" where there is none."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return ""
    _, a, b = alike([like, low, high])
    return f"[{a},{NOBREAK}{b}]"


def percent(value: float, least_decimals: int = 1) -> str:
    """Such as "98.6 %"; more digits where the value is nearly all or nothing."""
    if not math.isfinite(value):
        return "\u2013"
    decimals = least_decimals
    left = abs(100 - abs(value))
    if 0 < left < 0.5:
        decimals = max(decimals, 1 - math.floor(math.log10(left)))
    return f"{value:.{min(decimals, 4)}f}{SPACE}%".replace("-", MINUS)


def percent_with_interval(value: float, low: float, high: float) -> tuple[str, str]:
    """Such as ("99.01 %", "[98.98, 99.04]"): as many decimals as the interval needs; "" where there is none."""
    half = (high - low) / 2
    if not half > 0 or not math.isfinite(half):
        return percent(value), ""
    decimals = min(max(1, -math.floor(math.log10(half))), 3)
    texts = [f"{v:.{decimals}f}".replace("-", MINUS) for v in (value, low, high)]
    return f"{texts[0]}{SPACE}%", f"[{texts[1]},{NOBREAK}{texts[2]}]"


def duration(seconds: float, exact: bool = False) -> str:
    """A time in the unit that suits it: 40.3 µs, 14.2 ms, 2.10 s. exact: without zeros at its end."""
    if not math.isfinite(seconds):
        return "\u2013"
    for factor, unit in ((1.0, "s"), (1e3, "ms"), (1e6, "µs")):
        if factor * seconds >= 1 or unit == "µs":
            value = factor * seconds
            decimals = 0 if exact or value >= 100 else 1 if value >= 10 else 2
            return f"{value:g}{SPACE}{unit}" if exact else f"{value:.{decimals}f}{SPACE}{unit}"
    return ""


def probability(p: float) -> str:
    """Such as "p < 0.001" or "p = 0.031"."""
    if not math.isfinite(p):
        return ""
    text = "p < 0.001" if p < 0.001 else f"p = {p:.3f}" if p < 0.1 else f"p = {p:.2f}"
    return text.replace(" ", NOBREAK)


def times(ratio: float) -> str:
    """How many times smaller: 84, 4.3, 1.05."""
    return f"{ratio:.0f}" if ratio >= 9.95 else f"{ratio:.1f}" if ratio >= 2 else f"{ratio:.2f}"


def listed(words: list[str], last: str = "and") -> str:
    """Such as "circle, lemniscate and hover"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {last} {words[-1]}" if words else ""


def span(values: list[float], unit: str) -> str:
    """Such as "4 to 12 m/s"."""
    low, high = min(values), max(values)
    return f"{low:g}{SPACE}{unit}" if low == high else f"{low:g} to {high:g}{SPACE}{unit}"
