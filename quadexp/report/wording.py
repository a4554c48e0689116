"""Numbers as text, and the lines below a table that say what its numbers are."""

from __future__ import annotations

import math
from collections.abc import Sequence

from quadexp.report.inference import least_p
from quadexp.report.overall import Overall
from quadexp.report.statistics import Statistic

LARGE_ATTITUDE = math.radians(10.0)  # rms angle to the reference's attitude from which a table says so
METHODS = {"BCa": "BCa bootstrap", "t": "Student's t"}  # of intervals, see inference.Interval


def significant(value: float, least: int = 1) -> str:
    """Three significant digits or one decimal, whichever says more: 0.0123, 1.23, 12.3, 123.4. least: decimals."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    return f"{value:.{max(least, 2 - math.floor(math.log10(abs(value))))}f}"


def with_interval(mean: float, low: float, high: float) -> tuple[str, str]:
    """Such as ("240.6", " [239.9, 241.2]"): as many decimals as the interval needs; ("240.6", "") without one."""
    half = (high - low) / 2
    least = max(1, -math.floor(math.log10(half))) if half > 0 and math.isfinite(half) else 1
    text = significant(mean, least)
    if math.isnan(half):
        return text, ""
    decimals = len(text.partition(".")[2])
    return text, f" [{low:.{decimals}f}, {high:.{decimals}f}]"


def notes(statistics: Sequence[Statistic], pooled: Sequence[Overall]) -> tuple[str, ...]:
    """What the numbers of a table are, and each contestant against the baseline over all conditions."""
    used = [text for name, text in METHODS.items() if any(s.interval == name for s in statistics)]
    confidence = statistics[0].confidence
    interval = f" [{100 * confidence:g} % interval: {' or '.join(used)}]" if used else ""
    seeds = sorted({s.seeds for s in statistics})
    count = f"{seeds[0]} seed{'s' if seeds[-1] > 1 else ''}" if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]} seeds"
    said = [f"mean over {count}{interval}; bold: least of those with the fewest failures"]
    tested = [s for s in statistics if s.comparisons]
    alpha = 1 - confidence
    if tested:
        comparisons, pairs = tested[0].comparisons, max(s.pairs for s in tested)
        over = f"{comparisons} comparison{'s' if comparisons > 1 else ''}"
        if comparisons * least_p(pairs) < alpha:
            test = f"p < {alpha:.2g}, paired permutation test, Holm over {over}"
            said.append(f"* differs from {tested[0].baseline}: {test}")
        else:
            enough = math.floor(2 + math.log2(comparisons / alpha))
            said.append(
                f"{pairs} pairs a line cannot show significance (p is {least_p(pairs):.3g} at least, over {over}):"
                f" {enough} could"
            )
    elif not any(s.baseline for s in statistics) and len({s.contestant for s in statistics}) > 1:
        said.append("no comparison: the baseline (evaluate.baseline) is not among these controllers")
    return (*said, *(entry.text() for entry in pooled))


def attitude_notes(statistics: Sequence[Statistic]) -> tuple[str, ...]:
    """One line on contestants whose attitude is far from the reference's, each at its worst; nothing where none is.

    statistics: of attitude_rmse (rad). A position error alone does not show a heading that lags behind.
    """
    worst: dict[str, Statistic] = {}
    for s in statistics:
        if s.mean > LARGE_ATTITUDE and s.mean > (worst[s.label].mean if s.label in worst else 0.0):
            worst[s.label] = s
    if not worst:
        return ()
    parts = [
        f"{label} {math.degrees(s.mean):.1f} deg on {s.trajectory}" + ("" if math.isnan(s.speed) else f" {s.speed:g}")
        for label, s in worst.items()
    ]
    return (f"attitude error (rms) above {math.degrees(LARGE_ATTITUDE):.0f} deg, at its largest: {', '.join(parts)}",)


def number(value: float) -> str:
    """As `significant`, but tiny values with a power of ten, and "-" for NaN."""
    return "-" if math.isnan(value) else f"{value:.2e}" if 0 < abs(value) < 1e-5 else significant(value)


def said_p(p: float) -> str:
    """Such as "0.031", "< 0.0001", or "-" where there is none."""
    return "-" if math.isnan(p) else "< 0.0001" if p < 1e-4 else f"{p:.2g}"
