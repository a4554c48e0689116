"""A logger that died for a while: the state stands still or runs along a straight line, to the last digit.

    |x(t + h) - 2 x(t) + x(t - h)| ~ 0      for position and velocity at once, h = 50 ms

A sensor's noise, or flying, bends every signal within 50 ms; interpolation between the last value before a loss and the
first one after it does not. A smooth start or end is no loss (a simulated flight at rest): there must be a kink.
"""

from __future__ import annotations

import numpy as np

from quadexp.log.finding import Finding, place, span
from quadexp.log.signal.crop import runs

STEP = 0.05  # s
LEAST = 0.4  # s: shorter ones are lost samples that were bridged
STRAIGHT = 2e-3  # of the usual bend
KINK = 3.0  # usual bends, at one end at least
ROUNDED = 0.1  # of the usual bend: coarser digits cannot tell a line
BLOCKS = 0.005  # share of the samples
CUT = "`import --bad-rows gap` (or drop) cuts it out"


def check_dead(streams: dict[str, np.ndarray], t: np.ndarray) -> tuple[list[Finding], np.ndarray]:
    """Stretches where the whole state is a straight line, as one finding; and the mask of their samples, (k,)."""
    dead = np.zeros(len(t), bool)
    step = float(np.median(np.diff(t))) if len(t) > 2 else 0.0
    m = max(1, round(STEP / step)) if step > 0 else 0
    names = [name for name in "pv" if name in streams]
    if not m or len(t) < 20 * m or not names:
        return [], dead
    x = np.concatenate([streams[name] for name in names], axis=1)
    bend, usual, limit = _bend(x, t, m)
    if not bend.shape[1]:
        return [], dead
    found = []
    for start, stop in runs(np.asarray((bend <= limit).all(axis=1))):
        low, high = max(0, start - m), min(len(t), stop + m)  # the line goes on to where its ends are
        kink = max(float((bend[part] / usual).max(initial=0.0)) for part in (slice(low, start), slice(stop, stop + m)))
        if t[high - 1] - t[low] >= LEAST and kink > KINK:
            dead[low:high] = True
            found.append((low, high))
    if not found:
        return [], dead
    start, stop = max(found, key=lambda run: run[1] - run[0])
    what = "stands still" if np.ptp(x[start:stop], axis=0).max() == 0 else "is a straight line"
    several = f", {len(found)} such stretches" if len(found) > 1 else ""
    text = f"the state {what} for {t[stop - 1] - t[start]:.2f} s ({dead.mean():.1%} of the samples{several})"
    text += ": nothing was logged, values were filled in"
    severity = "blocking" if dead.mean() > BLOCKS else "warning"
    where = f"{', '.join(f'{name}_*' for name in names)}, {place(start, stop, t)}"
    return [Finding("dead_logger", severity, where, text, f"{LEAST:g} s", CUT, span(t, start, stop))], dead


def _bend(x: np.ndarray, t: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Second differences over m samples, (k, columns); the usual one, and up to which one counts as zero, (columns,).

    A line may have been drawn over the times or over the samples. Columns that cannot tell are left out: those that
    never bend, and those whose last digit is too coarse.
    """
    bend = np.full(x.shape, np.inf)
    first, middle, last = x[: -2 * m], x[m:-m], x[2 * m :]
    share = ((t[m:-m] - t[: -2 * m]) / np.maximum(t[2 * m :] - t[: -2 * m], 1e-9))[:, None]
    bend[m:-m] = 2 * np.minimum(*(np.abs(first + s * (last - first) - middle) for s in (share, 0.5)))
    bend[~np.isfinite(bend)] = np.inf
    kept, usual, limit = [], [], []
    for i, column in enumerate(x.T):
        inner = bend[m:-m, i]
        inner = inner[np.isfinite(inner) & (inner > 1e-12 * max(1e-12, np.nanmax(np.abs(column))))]
        if len(inner) < 10:
            continue
        size, digit = float(np.median(inner)), _digit(column)
        if 4.2 * digit <= ROUNDED * size:
            kept.append(i)
            usual.append(size)
            limit.append(max(STRAIGHT * size, 4.2 * digit))
    return bend[:, kept], np.array(usual), np.array(limit)


def _digit(column: np.ndarray) -> float:
    """The last digit of rounded values; 0 where they are not rounded."""
    part = column[np.isfinite(column)][:2000]
    for places in range(8):
        if np.abs(part * 10**places - np.round(part * 10**places)).max(initial=1.0) < 1e-6 * 10**places * 1e-3:
            return 10.0**-places
    return 0.0
