"""Bad samples: not finite, repeated, frozen, spikes, filled in by a dead logger, and a clock that goes wrong."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quadexp.log.runs import longest, period_of, runs
from quadexp.physics.state import norms
from quadexp.plugins.check.candidates import COLUMNS, KEYS
from quadexp.plugins.logs.finding import Finding, of_rows
from quadexp.plugins.logs.signal.windows import STREAMS, attitude_rate

NORM, NORM_BLOCKS = 0.01, 0.1  # of a quaternion: what rounding to two digits leaves
FROZEN = 0.2  # s
LEAST_ROWS = 8  # fewer equal values in a row may be a coarse sensor's
MOVES = 0.05  # rad/s or m/s: what a frozen sensor would have had to see
MOST_ROWS = 20_000  # that are looked at for axes that never move
MANY_OUTLIERS, LEAST_OUTLIERS = 0.005, 8  # share of the samples, and samples, beyond which spikes block
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
    alike: dict[bytes, tuple[np.ndarray, list[str]]] = {}
    for name, values in columns.items():
        bad = ~np.isfinite(values) if values.dtype.kind == "f" and name != "t" else np.zeros(len(t), bool)
        if bad.any():
            alike.setdefault(bad.tobytes(), (bad, []))[1].append(name)
    findings = []
    for bad, names in alike.values():
        count = len(runs(bad))
        text = f"{bad.sum()} values in {count} {'run' if count == 1 else 'runs'}"
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
    again = first[inverse.ravel()] < np.arange(len(t))
    for start, stop in runs(np.concatenate([[False], number[1:] == number[:-1]])):
        again[start:stop] &= stop - start < LEAST_ROWS  # else all sensors froze, or nothing moves: see check_frozen
    if again.sum() < 2:
        return [], kept
    rows = longest(again)
    source = int(first[inverse.ravel()[rows[0]]])
    text = f"{again.sum()} samples ({again.mean():.2%}) repeat earlier ones to the last digit, these {source} and on"
    severity = "blocking" if again.mean() > 0.001 else "warning"
    return [of_rows("duplicated_rows", severity, "", rows, t, text, "none")], kept & ~again


def row_numbers(columns: list[np.ndarray]) -> np.ndarray:
    """A number for every sample, (k,): the same for the same bits, another one (but for 1 in 2^64) for others."""
    total = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        total += np.ascontiguousarray(column, dtype=float).view(np.uint64)
        total ^= total >> np.uint64(29)
        total *= np.uint64(0xBF58476D1CE4E5B9)  # steps of splitmix64 (Steele et al. 2014), each one to one
        total ^= total >> np.uint64(32)
    return total


def check_frozen(streams: dict[str, np.ndarray], t: np.ndarray) -> tuple[list[Finding], np.ndarray]:
    """Sensors that repeat one value while the vehicle moves; and the mask of those samples, (k,)."""
    findings, frozen = [], np.zeros(len(t), bool)
    step = period_of(t) if len(t) > 2 else 0.0
    least = max(LEAST_ROWS, int(np.ceil(FROZEN / step))) if step > 0 else len(t) + 1
    moving = _moving(streams, t)
    for name, values in streams.items():
        same = np.concatenate([(values[1:] == values[:-1]).all(axis=1), [False]])  # as the next one
        stuck, mask = 0, np.zeros(len(t), bool)
        for start, stop in runs(same):
            if stop - start + 1 >= least and np.mean(moving[name][start : stop + 1]) > MOVES:
                mask[start : stop + 1], stuck = True, stuck + 1
        frozen |= mask
        if stuck:
            worst = longest(mask)
            text = f"one value for {t[worst[1] - 1] - t[worst[0]]:.2f} s while the vehicle moves, {stuck} times"
            text += f" ({mask.mean():.1%} of the samples)"
            severity = "blocking" if mask.mean() > 0.02 else "warning"
            findings.append(of_rows("frozen_sensor", severity, COLUMNS[name], worst, t, text, f"{FROZEN:g} s"))
        elif columns := _still_axes(name, streams, t):
            text = "one value throughout while the vehicle moves along it"
            findings.append(Finding("frozen_sensor", "blocking", columns, text, f"{FROZEN:g} s"))
    return findings, frozen


def _still_axes(name: str, streams: dict[str, np.ndarray], t: np.ndarray) -> str:
    """Columns that never change though another stream moves along them.

    A simulated flight in a plane has axes that never change, and its attitude too: nothing is wrong with it.
    """
    still, twin = np.ptp(streams[name], axis=0) == 0, {"p": "v", "v": "p", "w": "q"}.get(name, "")
    if still.all() or not still.any() or twin not in streams:
        return ""
    part = slice(None, None, max(1, len(t) // MOST_ROWS))
    other = streams[twin][part]
    if name == "v":
        other = np.diff(other, axis=0) / np.diff(t[part])[:, None]
    elif name == "w":
        other = attitude_rate(t[part], other)
    moves = np.sqrt(np.nanmean(other**2, axis=0)) > MOVES
    return " ".join(column for column, dead in zip(STREAMS[name], still & moves, strict=True) if dead)


def _moving(streams: dict[str, np.ndarray], t: np.ndarray) -> dict[str, np.ndarray]:
    """Rate and speed of the vehicle (rad/s, m/s), (k,), from the streams other than the named one."""
    zero = np.zeros(len(t))

    def change(x: np.ndarray, sign: float = 1.0) -> np.ndarray:
        """Length of x_k+1 - sign x_k over the step."""
        length = norms(x[1:] - sign * x[:-1]) / np.maximum(np.diff(t), 1e-9)
        return np.nan_to_num(np.append(length, 0.0))

    motion = {name: np.nan_to_num(norms(streams[name])) for name in "vw" if name in streams}
    if "p" in streams:
        motion["p"] = change(streams["p"])
    if "q" in streams:  # twice the chord of half the angle
        motion["q"] = 2 * np.minimum(change(streams["q"]), change(streams["q"], -1.0))
    twins = {name: motion.get(twin, zero) for name, twin in zip("pvqw", "vpwq", strict=True)}
    return {**twins, "f": sum(motion.values(), zero)}


def check_spikes(
    streams: dict[str, np.ndarray], t: np.ndarray, limit: dict[str, float]
) -> tuple[list[Finding], dict[str, np.ndarray]]:
    """Single values far from their neighbours, or beyond a limit; masks of those samples by stream.

    limit: largest magnitude that the vehicle allows, by stream.
    """
    from scipy.ndimage import median_filter

    findings, masks = [], {}
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
        row, axis = divmod(int(np.argmax(np.where(beyond, size, 0.0)[:, None] + apart / threshold)), 3)
        text = f"{values[row, axis]:.4g}, {apart[row, axis]:.3g} from its neighbours"
        allowed = f"{threshold[axis]:.3g} from the neighbours"
        if beyond[row]:
            axis = int(np.argmax(np.abs(finite[row])))
            text = f"magnitude {size[row]:.4g}, {STREAMS[name][axis]} {values[row, axis]:.4g}"
            allowed = f"magnitude {limit[name]:.3g}"
        many = max(LEAST_OUTLIERS, MANY_OUTLIERS * len(t))
        severity = "blocking" if bad.sum() > many or beyond.sum() > max(2, 0.0005 * len(t)) else "warning"
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
    m = max(1, round(BEND_STEP / step)) if step > 0 else 0
    names = [name for name in "pv" if name in streams]
    if not m or len(t) < 20 * m or not names:
        return [], dead
    x = np.concatenate([streams[name] for name in names], axis=1)
    bend, usual, limit = _bend(x, t, m)
    longest_line, lines = (0, 0), 0
    for start, stop in runs(np.asarray((bend <= limit).all(axis=1))) if len(usual) else ():
        low, high = max(0, start - m), min(len(t), stop + m)  # the line goes on to where its ends are
        kink = max(float((bend[part] / usual).max(initial=0.0)) for part in (slice(low, start), slice(stop, stop + m)))
        if t[high - 1] - t[low] >= LEAST_LINE and kink > KINK:
            dead[low:high], lines = True, lines + 1
            longest_line = max(longest_line, (low, high), key=lambda line: line[1] - line[0])
    if not lines:
        return [], dead
    start, stop = longest_line
    what = "stands still" if np.ptp(x[start:stop], axis=0).max() == 0 else "is a straight line"
    several = f", {lines} such stretches" if lines > 1 else ""
    text = f"the state {what} for {t[stop - 1] - t[start]:.2f} s ({dead.mean():.1%} of the samples{several})"
    text += ": nothing was logged, values were filled in"
    severity = "blocking" if dead.mean() > LINE_BLOCKS else "warning"
    columns = ", ".join(COLUMNS[name] for name in names)
    return [of_rows("dead_logger", severity, columns, longest_line, t, text, f"{LEAST_LINE:g} s", CUT)], dead


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
    least = 1e-12 * np.maximum(1e-12, np.nanmax(np.abs(x), axis=0))
    inner = np.where(np.isfinite(bend) & (bend > least), bend, np.nan)
    tells = np.isfinite(inner).sum(axis=0) >= 10
    usual = np.array([np.nanmedian(column) if known else 0.0 for column, known in zip(inner.T, tells, strict=True)])
    digit = 4.2 * np.array([_digit(column) for column in x.T])
    tells &= digit <= ROUNDED * usual
    return bend[:, tells], usual[tells], np.maximum(STRAIGHT * usual, digit)[tells]


def _digit(column: np.ndarray) -> float:
    """The last digit of rounded values; 0 where they are not rounded."""
    part = column[np.isfinite(column)][:2000]
    for places in range(8):
        if np.abs(part * 10**places - np.round(part * 10**places)).max(initial=1.0) < 1e-6 * 10**places * 1e-3:
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
    findings: list[Finding] = []

    def add(name: str, severity: str, k: int, text: str, allowed: str, advice: str = "", last: int = -1) -> None:
        span = (float(t[k]), float(t[last])) if last >= 0 else None
        findings.append(Finding(name, severity, f"t, sample {k + 1}", text, allowed, advice, span))

    steps = np.diff(t)
    back, same, positive = np.flatnonzero(steps < 0), np.flatnonzero(steps == 0), steps[steps > 0]
    if len(back):
        k = int(back[np.argmin(steps[back])])
        text = f"{steps[k]:+.4g} s, {len(back)} times: from {t[k]:.4f} to {t[k + 1]:.4f} s"
        add("clock_jump", "blocking", k, text, "t increases", "cut the log there", k)
    if len(same):
        text = f"{len(same)} samples have the time of the sample before"
        add("clock_repeated", "blocking", int(same[0]), text, "t increases")
    if not len(positive):
        return findings
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
        add("gap", severity, k, text, allowed, advice, k + 1)
    few = np.flatnonzero((steps > MISSING * period) & ~long & ~marked)
    if len(few):
        lost = int(np.sum(np.round(steps[few] / period) - 1))
        share = lost / (len(t) + lost)
        text = f"{lost} samples missing at {len(few)} places ({share:.2%})"
        severity = "warning" if share > MANY_MISSING else "info"
        add("dropped_samples", severity, int(few[0]), text, f"{MANY_MISSING:.0%} of the samples")
    return findings


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
    speed, gone = np.linalg.norm((before + after) / 2), np.linalg.norm(p[k + 1] - p[k])
    turned = np.linalg.norm(after - before)
    # a vehicle that flew on for the whole step would be far away, or would have changed its velocity; NaN is no leap
    return bool(speed * (t[k + 1] - t[k]) > 0.05 and gone < 3 * speed * period + 0.01 and turned < 0.2 * speed + 0.05)
