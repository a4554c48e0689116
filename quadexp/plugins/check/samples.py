"""Bad samples: not finite, repeated, frozen, spikes, filled in by a dead logger, and a clock that goes wrong."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quadexp.log.runs import longest, period_of, runs
from quadexp.physics.rotation import continuous
from quadexp.physics.state import norms
from quadexp.plugins.check.candidates import COLUMNS, KEYS
from quadexp.plugins.logs.finding import Finding, of_rows
from quadexp.plugins.logs.signal.windows import STREAMS, attitude_rate
from quadexp.report.text import count as counted

NORM = 0.01  # of a quaternion: what rounding to two digits leaves
NORM_BLOCKS = 0.1  # from which on it is no rotation
FROZEN = 0.2  # s
LEAST_ROWS = 8  # fewer equal values in a row may be a coarse sensor's
FROZEN_BLOCKS = 0.02  # share of the samples
MOVES = 0.05  # rad/s or m/s: what a frozen sensor would have had to see
TWINS = {"p": "v", "v": "p", "q": "w", "w": "q"}  # the stream that sees the same motion
MOST_ROWS = 20_000  # that are looked at for axes that never move
MANY_OUTLIERS = 0.005  # share of the samples beyond which spikes block
LEAST_OUTLIERS = 8  # samples that do not block
MANY_BEYOND = 0.0005  # share of the samples, of those that no vehicle can have
SPIKE = 12.0  # robust standard deviations
# The least that counts as a spike: beyond what flying does within a few samples.
SPIKE_FLOOR = {"p": 0.05, "v": 0.5, "w": 8.0, "f": 30.0}
# Of a logger that died:
BEND_STEP = 0.05  # s
LEAST_LINE = 0.4  # s: shorter ones are lost samples that were bridged
STRAIGHT = 2e-3  # of the usual bend
KINK = 3.0  # usual bends, at one end at least
ROUNDED = 0.1  # of the usual bend: coarser digits cannot tell a line
LINE_BLOCKS = 0.005  # share of the samples
CUT = "`import --bad-rows gap` (or drop) cuts it out"
# Of the clock:
GAP = 5.0  # periods
MISSING = 1.5  # periods: a step longer than that lacks samples
MANY_MISSING = 0.02  # share of the samples


def check_finite(columns: dict[str, np.ndarray], t: np.ndarray) -> list[Finding]:
    """Columns with NaN or infinity; those that fail in the same samples as one finding."""
    alike: dict[bytes, list[str]] = {}
    for name, values in columns.items():
        if values.dtype.kind == "f" and name != "t" and not np.isfinite(values).all():
            alike.setdefault(np.isfinite(values).tobytes(), []).append(name)
    findings = []
    for names in alike.values():
        bad = ~np.isfinite(columns[names[0]])
        text = f"{bad.sum()} values in {counted(len(runs(bad)), 'run')}"
        findings.append(of_rows("not_finite", "blocking", " ".join(names), longest(bad), t, text, "none", ""))
    return findings


def check_quaternion(q: np.ndarray, t: np.ndarray) -> list[Finding]:
    """Norm of quaternions (k, 4)."""
    off = np.abs(np.nan_to_num(norms(q), nan=1.0, posinf=1.0) - 1)
    if off.max(initial=0) <= NORM:
        return []
    text = f"norm off by {off.max():.3g}, {np.mean(off > NORM):.2%} of the samples by more than allowed"
    severity = "blocking" if off.max() > NORM_BLOCKS else "warning"
    return [of_rows("quaternion_norm", severity, "q_*", longest(off > NORM), t, text, f"{NORM:g}", "")]


def check_repeats(columns: dict[str, np.ndarray], t: np.ndarray) -> tuple[list[Finding], np.ndarray]:
    """Samples that occur twice, time aside; and a mask of the first of each, (k,)."""
    names = [name for name in columns if name not in ("t", "segment") and columns[name].dtype.kind in "fiu"]
    kept = np.ones(len(t), bool)
    if not names or len(t) < LEAST_ROWS:
        return [], kept
    number = row_numbers([columns[name] for name in names])
    _, first, inverse = np.unique(number, return_index=True, return_inverse=True)
    earliest = first[inverse]
    again = earliest < np.arange(len(t))
    for start, stop in runs(np.append(False, number[1:] == number[:-1])):
        again[start:stop] &= stop - start < LEAST_ROWS  # else all sensors froze, or nothing moves: see check_frozen
    if again.sum() < 2:
        return [], kept
    rows = longest(again)
    source = earliest[rows[0]]
    text = f"{again.sum()} samples ({again.mean():.2%}) repeat earlier ones to the last digit, these {source} and on"
    severity = "blocking" if again.mean() > 0.001 else "warning"
    return [of_rows("duplicated_rows", severity, "", rows, t, text, "none")], kept & ~again


def row_numbers(columns: list[np.ndarray]) -> np.ndarray:
    """A number for every sample, (k,): the same for the same values, another one (but for 1 in 2^64) for others."""
    import pandas as pd

    return pd.util.hash_pandas_object(pd.DataFrame(dict(enumerate(columns))), index=False).to_numpy()


def check_frozen(streams: dict[str, np.ndarray], t: np.ndarray) -> tuple[list[Finding], np.ndarray]:
    """Sensors that repeat one value while the vehicle moves; and the mask of those samples, (k,)."""
    findings = []
    frozen = np.zeros(len(t), bool)
    step = period_of(t)
    least = max(LEAST_ROWS, int(np.ceil(FROZEN / step))) if step > 0 else len(t) + 1
    for name, values in streams.items():
        motion = _motion(streams, t, name)
        as_next = np.append((values[1:] == values[:-1]).all(axis=1), False)
        mask = np.zeros(len(t), bool)
        for start, stop in runs(as_next):
            stuck = slice(start, stop + 1)
            if stop + 1 - start >= least and np.mean(motion[stuck]) > MOVES:
                mask[stuck] = True
        frozen |= mask
        if mask.any():
            start, stop = longest(mask)
            text = f"one value for {t[stop - 1] - t[start]:.2f} s while the vehicle moves, {len(runs(mask))} times"
            text += f" ({mask.mean():.1%} of the samples)"
            severity = "blocking" if mask.mean() > FROZEN_BLOCKS else "warning"
            findings.append(of_rows("frozen_sensor", severity, COLUMNS[name], (start, stop), t, text, f"{FROZEN:g} s"))
            continue
        columns = _still_axes(name, streams, t)
        if columns:
            text = "one value throughout while the vehicle moves along it"
            findings.append(Finding("frozen_sensor", "blocking", columns, text, f"{FROZEN:g} s"))
    return findings, frozen


def _still_axes(name: str, streams: dict[str, np.ndarray], t: np.ndarray) -> str:
    """Columns that never change though another stream moves along them.

    A simulated flight in a plane has axes that never change, and its attitude too: nothing is wrong with it.
    """
    still = np.ptp(streams[name], axis=0) == 0
    twin = TWINS.get(name, "")
    if still.all() or not still.any() or name == "q" or twin not in streams:
        return ""
    thinned = slice(None, None, max(1, len(t) // MOST_ROWS))
    other = streams[twin][thinned]
    if name == "v":
        other = np.diff(other, axis=0) / np.diff(t[thinned])[:, None]
    elif name == "w":
        other = attitude_rate(t[thinned], other)
    moves = np.sqrt(np.nanmean(other**2, axis=0)) > MOVES
    return " ".join(np.array(STREAMS[name])[still & moves])


def _motion(streams: dict[str, np.ndarray], t: np.ndarray, name: str) -> np.ndarray:
    """Rate or speed of the vehicle (rad/s, m/s), (k,), from the twin of the named stream; of an accelerometer, the sum
    of all."""
    total = np.zeros(len(t))
    for twin in TWINS if name == "f" else TWINS[name]:
        if twin not in streams:
            continue
        x = streams[twin]
        if twin == "q":  # twice the chord of half the angle
            x = 2 * continuous(np.nan_to_num(x))
        if twin in "pq":
            x = np.diff(x, axis=0, append=x[-1:]) / np.maximum(np.diff(t, append=np.inf), 1e-9)[:, None]
        total += np.nan_to_num(norms(x))
    return total


def check_spikes(
    streams: Mapping[str, np.ndarray], t: np.ndarray, limit: dict[str, float]
) -> tuple[list[Finding], dict[str, np.ndarray]]:
    """Single values far from their neighbours, or beyond a limit; masks of those samples by stream.

    limit: largest magnitude that the vehicle allows, by stream.
    """
    from scipy.ndimage import median_filter

    findings = []
    masks = {}
    gaps = np.flatnonzero(np.diff(t) > GAP * period_of(t)) + 1  # over which nothing is a neighbour
    for name, values in streams.items():
        if name == "q" or len(t) < 9:
            continue
        finite = np.where(np.isfinite(values), values, 0)
        size = norms(finite)
        beyond = size > limit.get(name, np.inf)
        around = [median_filter(part, (7, 1), mode="nearest") for part in np.split(finite, gaps)]
        apart = np.abs(finite - np.concatenate(around))
        threshold = np.maximum(SPIKE * 1.4826 * np.median(apart, axis=0), SPIKE_FLOOR[name])
        bad = beyond | (apart > threshold).any(axis=1)
        if not bad.any():
            continue
        masks[name] = bad
        score = np.where(beyond, size, 0.0)[:, None] + apart / threshold
        row, axis = np.unravel_index(np.argmax(score), score.shape)
        if beyond[row]:
            axis = np.argmax(np.abs(finite[row]))
            text = f"magnitude {size[row]:.4g}, {STREAMS[name][axis]} {values[row, axis]:.4g}"
            allowed = f"magnitude {limit[name]:.3g}"
        else:
            text = f"{values[row, axis]:.4g}, {apart[row, axis]:.3g} from its neighbours"
            allowed = f"{threshold[axis]:.3g} from the neighbours"
        many = bad.sum() > max(LEAST_OUTLIERS, MANY_OUTLIERS * len(t))
        impossible = beyond.sum() > max(2, MANY_BEYOND * len(t))
        severity = "blocking" if many or impossible else "warning"
        text += f"; {bad.sum()} samples ({bad.mean():.2%})"
        rows = next(run for run in runs(bad) if run[0] <= row < run[1])
        findings.append(of_rows(f"{KEYS[name]}_outlier", severity, STREAMS[name][axis], rows, t, text, allowed))
    return findings, masks


def check_dead(streams: dict[str, np.ndarray], t: np.ndarray) -> tuple[list[Finding], np.ndarray]:
    """Where a logger died, the state stands still or runs along a straight line to the last digit: one finding, and the
    mask of those samples, (k,).

        |x(t + h) - 2 x(t) + x(t - h)| ~ 0      for position and velocity at once, h = 50 ms

    Noise, or flying, bends every signal within 50 ms. A smooth start or end is no loss: there must be a kink.
    """
    dead = np.zeros(len(t), bool)
    step = period_of(t)
    names = [name for name in "pv" if name in streams]
    m = max(1, round(BEND_STEP / step)) if step > 0 else len(t)
    if len(t) < 20 * m or not names:
        return [], dead
    x = np.concatenate([streams[name] for name in names], axis=1)
    bends = []
    for column in x.T:
        of_column = _bend(column, t, m)
        if of_column is not None:
            bends.append(of_column)
    if not bends:
        return [], dead
    bend = np.max([bend for bend, _ in bends], axis=0)
    straight = np.all([bend <= limit for bend, limit in bends], axis=0)
    lines = 0
    for start, stop in runs(straight):
        ends = np.append(bend[max(0, start - m) : start], bend[stop : stop + m])
        line = slice(max(0, start - m), min(len(t), stop + m))  # it goes on to where its ends are
        if t[line][-1] - t[line][0] >= LEAST_LINE and ends.max(initial=0.0) > KINK:
            dead[line] = True
            lines += 1
    if not lines:
        return [], dead
    start, stop = longest(dead)
    what = "is a straight line"
    if np.ptp(x[start:stop], axis=0).max() == 0:
        what = "stands still"
    several = f", {lines} such stretches" if lines > 1 else ""
    text = f"the state {what} for {t[stop - 1] - t[start]:.2f} s ({dead.mean():.1%} of the samples{several})"
    text += ": nothing was logged, values were filled in"
    severity = "blocking" if dead.mean() > LINE_BLOCKS else "warning"
    columns = ", ".join(COLUMNS[name] for name in names)
    return [of_rows("dead_logger", severity, columns, (start, stop), t, text, f"{LEAST_LINE:g} s", CUT)], dead


def _bend(x: np.ndarray, t: np.ndarray, m: int) -> tuple[np.ndarray, float] | None:
    """Second difference of a column over m samples, (k,), and up to which one it counts as zero, both in usual ones;
    infinite at the ends and where a value is missing. None for a column that never bends, or is too coarse.

    A line may have been drawn over the times or over the samples.
    """
    bend = np.full(x.shape, np.inf)
    first = x[: -2 * m]
    middle = x[m:-m]
    last = x[2 * m :]
    share = (t[m:-m] - t[: -2 * m]) / np.maximum(t[2 * m :] - t[: -2 * m], 1e-9)
    over_time = np.abs(first + share * (last - first) - middle)
    over_samples = np.abs(first + 0.5 * (last - first) - middle)
    bend[m:-m] = 2 * np.minimum(over_time, over_samples)
    bend[~np.isfinite(bend)] = np.inf
    rounding = 1e-12 * max(1e-12, np.nanmax(np.abs(x)))
    telling = bend[np.isfinite(bend) & (bend > rounding)]
    if len(telling) < 10:
        return None
    usual = float(np.median(telling))
    coarse = 4.2 * _digit(x[np.isfinite(x)][:2000]) / usual  # four roundings
    if coarse > ROUNDED:
        return None
    return bend / usual, max(STRAIGHT, coarse)


def _digit(x: np.ndarray) -> float:
    """The last digit of rounded values; 0 where they are not rounded."""
    for places in range(8):
        if np.allclose(x, np.round(x, places), rtol=0.0, atol=1e-9):
            return 10.0**-places
    return 0.0


def check_clock(
    t: np.ndarray, streams: Mapping[str, np.ndarray] | None = None, segment: np.ndarray | None = None
) -> list[Finding]:
    """Findings about a clock t (k,) (s): backwards, repeated, leaping, with samples missing.

    A step longer than GAP periods is a gap if the flight went on meanwhile, and a leap of the clock if position did not
    move as far as the velocity times the step says. streams: p and v, (k, 3). segment (k,): gaps already marked.
    """
    bad = np.flatnonzero(~np.isfinite(t))
    if len(bad):
        return [Finding("not_finite", "blocking", f"t, sample {bad[0]}", f"{len(bad)} times", "none")]
    findings = []
    steps = np.diff(t)
    back = np.flatnonzero(steps < 0)
    if len(back):
        k = back[np.argmin(steps[back])]
        text = f"{steps[k]:+.4g} s, {len(back)} times: from {t[k]:.4f} to {t[k + 1]:.4f} s"
        when = (float(t[k]), float(t[k]))
        findings.append(Finding("clock_jump", "blocking", _after(k), text, "t increases", "cut the log there", when))
    same = np.flatnonzero(steps == 0)
    if len(same):
        text = f"{len(same)} samples have the time of the sample before"
        findings.append(Finding("clock_repeated", "blocking", _after(same[0]), text, "t increases"))
    if not (steps > 0).any():
        return findings
    period = float(np.median(steps[steps > 0]))
    allowed = f"{GAP:g} periods of {period:.4g} s"
    marked = np.diff(np.zeros(len(t)) if segment is None else segment) != 0
    long = np.flatnonzero(steps > GAP * period)
    leaps = np.array([k for k in long if _leaps(int(k), t, period, streams or {})], int)
    gaps = np.setdiff1d(long, leaps)
    if len(leaps):
        k = leaps[np.argmax(steps[leaps])]
        text = f"the clock leaps by {steps[k]:.3g} s at {t[k]:.2f} s, {len(leaps)} times; position does not"
        severity = "warning" if marked[leaps].all() else "blocking"
        findings.append(Finding("clock_jump", severity, _after(k), text, allowed))
    if len(gaps):
        k = gaps[np.argmax(steps[gaps])]
        span = (float(t[k]), float(t[k + 1]))
        text = f"{counted(len(gaps), 'gap')}, the longest {steps[k]:.3g} s at {t[k]:.2f} s"
        severity = "info"
        advice = ""
        if not marked[gaps].all():
            severity = "warning"
            advice = "import starts a new segment at a gap"
        findings.append(Finding("gap", severity, _after(k), text, allowed, advice, span))
    few = np.flatnonzero((steps > MISSING * period) & (steps <= GAP * period) & ~marked)
    if len(few):
        lost = int(np.sum(np.round(steps[few] / period) - 1))
        share = lost / (len(t) + lost)
        text = f"{lost} samples missing at {len(few)} places ({share:.2%})"
        severity = "warning" if share > MANY_MISSING else "info"
        many = f"{MANY_MISSING:.0%} of the samples"
        findings.append(Finding("dropped_samples", severity, _after(few[0]), text, many))
    return findings


def _after(k: int) -> str:
    """Where a step of the clock is, by the sample before."""
    return f"t, sample {k + 1}"


def _leaps(k: int, t: np.ndarray, period: float, streams: Mapping[str, np.ndarray]) -> bool:
    """Whether between samples k and k + 1 the clock moved and the vehicle did not."""
    if "p" not in streams or k < 2 or k + 3 > len(t):
        return False
    p = streams["p"]
    if "v" in streams:
        before = streams["v"][k]
        after = streams["v"][k + 1]
    else:
        before = (p[k] - p[k - 2]) / max(t[k] - t[k - 2], period)
        after = (p[k + 2] - p[k + 1]) / max(t[k + 2] - t[k + 1], period)
    speed = np.linalg.norm((before + after) / 2)
    gone = np.linalg.norm(p[k + 1] - p[k])
    turned = np.linalg.norm(after - before)
    # a vehicle that flew on for the whole step would be far away, or would have changed its velocity; NaN is no leap
    moves = speed * (t[k + 1] - t[k]) > 0.05
    stands = gone < 3 * speed * period + 0.01
    straight = turned < 0.2 * speed + 0.05
    return bool(moves and stands and straight)
