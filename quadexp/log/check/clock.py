"""The clock of a flight: backwards, repeated, leaping, with samples missing.

A step longer than `GAP` periods is a gap if the flight went on meanwhile, and a leap of the clock if position did not
move as far as the velocity times the step says.
"""

from __future__ import annotations

import numpy as np

from quadexp.log.finding import Finding, place, span

GAP = 5.0  # periods
MISSING = 1.5  # periods: a step longer than that lacks samples
MANY_MISSING = 0.02  # share of the samples


def check_clock(
    t: np.ndarray,
    *,
    position: np.ndarray | None = None,
    velocity: np.ndarray | None = None,
    segment: np.ndarray | None = None,
) -> list[Finding]:
    """Findings about a clock t (k,) (s).

    position (k, 3) (m), velocity (k, 3) (m/s): tell a leap of the clock from a gap. segment (k,): gaps already marked.
    """
    t = np.asarray(t, float)
    bad = np.flatnonzero(~np.isfinite(t))
    if len(bad):
        return [Finding("not_finite", "blocking", f"t, {place(bad[0], bad[0] + 1)}", f"{len(bad)} times", "none")]
    if len(t) < 3:
        return []
    steps = np.diff(t)
    found = []
    back = np.flatnonzero(steps < 0)
    if len(back):
        k = back[np.argmin(steps[back])]
        more = f", {len(back)} times" if len(back) > 1 else ""
        text = f"{steps[k]:+.4g} s{more}: from {t[k]:.4f} to {t[k + 1]:.4f} s"
        where = f"t, {place(k + 1, k + 2)}"
        found.append(
            Finding("clock_jump", "blocking", where, text, "t increases", "cut the log there", span(t, k, k + 1))
        )
    same = np.flatnonzero(steps == 0)
    if len(same):
        text = f"{len(same)} samples have the time of the sample before"
        found.append(
            Finding("clock_repeated", "blocking", f"t, {place(same[0] + 1, same[0] + 2)}", text, "t increases")
        )
    positive = steps[steps > 0]
    if not len(positive):
        return found
    period = float(np.median(positive))
    allowed = f"{GAP:g} periods of {period:.4g} s"
    marked = np.zeros(len(steps), bool) if segment is None else np.diff(segment) != 0
    long = np.flatnonzero(steps > GAP * period)
    leaps = [int(k) for k in long if _leaps(int(k), t, period, position, velocity)]
    gaps = [int(k) for k in long if k not in set(leaps)]
    if leaps:
        k = max(leaps, key=lambda k: steps[k])
        more = f", {len(leaps)} such" if len(leaps) > 1 else ""
        text = f"the clock leaps by {steps[k]:.3g} s at {t[k]:.2f} s, position goes on as if by {period:.3g} s{more}"
        severity = "warning" if marked[leaps].all() else "blocking"
        found.append(Finding("clock_jump", severity, f"t, {place(k + 1, k + 2)}", text, allowed))
    if gaps:
        k = max(gaps, key=lambda k: steps[k])
        text = f"{len(gaps)} {'gap' if len(gaps) == 1 else 'gaps'}, the longest {steps[k]:.3g} s at {t[k]:.2f} s"
        inside = [k for k in gaps if not marked[k]]
        severity, advice = ("info", "") if not inside else ("warning", "import starts a new segment at a gap")
        found.append(Finding("gap", severity, f"t, {place(k + 1, k + 2)}", text, allowed, advice, span(t, k, k + 2)))
    few = np.flatnonzero((steps > MISSING * period) & (steps <= GAP * period) & ~marked)
    if len(few):
        lost = int(np.sum(np.round(steps[few] / period) - 1))
        share = lost / (len(t) + lost)
        text = f"{lost} samples missing at {len(few)} places ({share:.2%})"
        severity = "warning" if share > MANY_MISSING else "info"
        where = f"t, {place(few[0] + 1, few[0] + 2)} first"
        found.append(Finding("dropped_samples", severity, where, text, f"{MANY_MISSING:.0%} of the samples"))
    return found


def _leaps(k: int, t: np.ndarray, period: float, position: np.ndarray | None, velocity: np.ndarray | None) -> bool:
    """Whether between samples k and k + 1 the clock moved and the vehicle did not."""
    if position is None or k < 2 or k + 3 > len(t):
        return False
    if velocity is None:
        before = (position[k] - position[k - 2]) / max(t[k] - t[k - 2], period)
        after = (position[k + 3 - 1] - position[k + 1]) / max(t[k + 2] - t[k + 1], period)
    else:
        before, after = velocity[k], velocity[k + 1]
    if not np.isfinite([*before, *after, *position[k], *position[k + 1]]).all():
        return False
    speed = np.linalg.norm((before + after) / 2)
    gone = np.linalg.norm(position[k + 1] - position[k])
    turned = np.linalg.norm(after - before)
    # a vehicle that flew on for the whole step would be far away, or would have changed its velocity
    return bool(speed * (t[k + 1] - t[k]) > 0.05 and gone < 3 * speed * period + 0.01 and turned < 0.2 * speed + 0.05)
