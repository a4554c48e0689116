"""The clock of a flight: backwards, repeated, leaping, with samples missing.

A step longer than `GAP` periods is a gap if the flight went on meanwhile, and a leap of the clock if position did not
move as far as the velocity times the step says.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quadexp.log.finding import Finding, place, span

GAP = 5.0  # periods
MISSING = 1.5  # periods: a step longer than that lacks samples
MANY_MISSING = 0.02  # share of the samples


def check_clock(
    t: np.ndarray, streams: Mapping[str, np.ndarray] | None = None, segment: np.ndarray | None = None
) -> list[Finding]:
    """Findings about a clock t (k,) (s).

    streams: position p and velocity v, (k, 3), tell a leap of the clock from a gap. segment (k,): gaps already marked.
    """
    found: list[Finding] = []

    def add(
        name: str, severity: str, k: int, text: str, allowed: str, advice: str = "", last: int | None = None
    ) -> None:
        when = None if last is None else span(t, k, last)
        found.append(Finding(name, severity, f"t, {place(k + 1, k + 2)}", text, allowed, advice, when))

    bad = np.flatnonzero(~np.isfinite(t))
    if len(bad):
        add("not_finite", "blocking", int(bad[0]) - 1, f"{len(bad)} times", "none")
        return found
    steps = np.diff(t)
    back, same, positive = np.flatnonzero(steps < 0), np.flatnonzero(steps == 0), steps[steps > 0]
    if len(back):
        k = int(back[np.argmin(steps[back])])
        text = f"{steps[k]:+.4g} s, {len(back)} times: from {t[k]:.4f} to {t[k + 1]:.4f} s"
        add("clock_jump", "blocking", k, text, "t increases", "cut the log there", k + 1)
    if len(same):
        text = f"{len(same)} samples have the time of the sample before"
        add("clock_repeated", "blocking", int(same[0]), text, "t increases")
    if not len(positive):
        return found
    period = float(np.median(positive))
    allowed = f"{GAP:g} periods of {period:.4g} s"
    marked = np.zeros(len(steps), bool) if segment is None else np.diff(segment) != 0
    long = steps > GAP * period
    leaps = np.array([k for k in np.flatnonzero(long) if _leaps(int(k), t, period, streams or {})], int)
    gaps = np.setdiff1d(np.flatnonzero(long), leaps)
    if len(leaps):
        k = int(leaps[np.argmax(steps[leaps])])
        text = f"the clock leaps by {steps[k]:.3g} s at {t[k]:.2f} s, {len(leaps)} times; position does not"
        add("clock_jump", "warning" if marked[leaps].all() else "blocking", k, text, allowed)
    if len(gaps):
        k = int(gaps[np.argmax(steps[gaps])])
        text = f"{len(gaps)} {'gap' if len(gaps) == 1 else 'gaps'}, the longest {steps[k]:.3g} s at {t[k]:.2f} s"
        severity, advice = ("info", "") if marked[gaps].all() else ("warning", "import starts a new segment at a gap")
        add("gap", severity, k, text, allowed, advice, k + 2)
    few = np.flatnonzero((steps > MISSING * period) & ~long & ~marked)
    if len(few):
        lost = int(np.sum(np.round(steps[few] / period) - 1))
        share = lost / (len(t) + lost)
        text = f"{lost} samples missing at {len(few)} places ({share:.2%})"
        severity = "warning" if share > MANY_MISSING else "info"
        add("dropped_samples", severity, int(few[0]), text, f"{MANY_MISSING:.0%} of the samples")
    return found


def _leaps(k: int, t: np.ndarray, period: float, streams: Mapping[str, np.ndarray]) -> bool:
    """Whether between samples k and k + 1 the clock moved and the vehicle did not."""
    if "p" not in streams or k < 2 or k + 3 > len(t):
        return False
    p = streams["p"]
    if "v" in streams:
        before, after = streams["v"][k], streams["v"][k + 1]
    else:
        before = (p[k] - p[k - 2]) / max(t[k] - t[k - 2], period)
        after = (p[k + 2] - p[k + 1]) / max(t[k + 2] - t[k + 1], period)
    if not np.isfinite([before, after, p[k], p[k + 1]]).all():
        return False
    speed, gone = np.linalg.norm((before + after) / 2), np.linalg.norm(p[k + 1] - p[k])
    turned = np.linalg.norm(after - before)
    # a vehicle that flew on for the whole step would be far away, or would have changed its velocity
    return bool(speed * (t[k + 1] - t[k]) > 0.05 and gone < 3 * speed * period + 0.01 and turned < 0.2 * speed + 0.05)
