"""Time offsets between what moves alike: gyro against the attitude's turning, accelerometer against velocity.
By cross-correlation, with a standard error:

    tau = argmax_tau  sum_j <a_j(t), b_j(t + tau)> / sqrt(sum_j |a_j|^2 sum_j |b_j|^2)

A positive offset: what `a` shows at t, `b` shows at t + tau, so b's clock is to be moved back by tau. Both streams are
brought to one clock and to one band (Gaussian low- and high-pass, without phase): above it noise dominates, below it
drift and drag shift the phase of a slow signal without any delay. The standard error is that of a jackknife over
stretches of the log. Offsets are reported only; moving a stream is asked for (`--align`).

A clock that runs at another rate shows as offsets that grow: a line (Theil 1950, Sen 1968) through those of stretches
of WINDOW seconds, each looked for about where the stretches before say,

    tau(t) = tau_m + drift (t - t_m)        t_m: middle of the log
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.log.runs import period_of
from quadexp.physics.rotation import continuous
from quadexp.physics.vehicle import GRAVITY
from quadexp.plugins.logs.signal import Stream, as_stream
from quadexp.plugins.logs.signal.resample import resample
from quadexp.plugins.logs.signal.windows import attitude_rate

LARGEST = 0.5  # s
BAND = 4.0  # Hz, -3 dB: vehicles turn slower, motion capture shakes faster
SLOWEST = 0.25  # Hz, -3 dB
BLOCK = 0.5  # s: the shortest stretch that tells
STRETCHES = 6  # their scatter gives the standard error; of 6 it is known to a third
LEAST_CORRELATION = 0.5  # a quarter of the variance is common
AMBIGUOUS = 0.97  # another peak as high as this share of the highest one
LARGEST_ERROR = 0.02  # s
LEAST_SAMPLES = 50  # of a stream; of fewer a correlation of 0.3 may be chance
# Which stream is compared with which other one, and with what correlation: an accelerometer feels more than the motion.
PAIRS = (("rate", "attitude", 0.7), ("acceleration", "velocity", 0.9), ("acceleration", "position", 0.9),
         ("position", "velocity", 0.9))  # fmt: skip
WINDOW, MOST_WINDOWS, LEAST_WINDOWS = 8.0, 24, 4  # s, and how many of them a line takes
LEAST_DRIFT = 3e-4  # s/s: quartz keeps a tenth of that
CLEARLY = 0.8  # of the misfit, below which the other side is taken to be late
SURELY = 5.0  # standard errors of a drift, of the stretches' own and of their scatter about the line
AROUND_LINE = 0.01  # s: what offsets of stretches may lie beside a line
PARTS, PART = 6, 20.0  # how many stretches of a long flight are looked at, and how long (s)


class Offset(NamedTuple):
    """seconds: of b behind a. error: its standard error (s). correlation: at the peak, -1..1.

    rival: height of the next peak over that of the first (near 1: periodic motion, cannot tell). certain: correlation
    above LEAST_CORRELATION, no rival, a small error, stretches of the log that agree, peak not at the edge.
    drift: by which it grows (s/s), 0 where that is not seen; seconds is then the offset at `middle` (s).
    """

    seconds: float
    error: float
    correlation: float
    rival: float
    certain: bool
    drift: float = 0.0
    middle: float = 0.0

    def at(self, t: np.ndarray) -> np.ndarray:
        """The offset at times t (k,) of b's clock (s)."""
        return self.seconds + self.drift * (t - self.middle)

    @property
    def words(self) -> str:
        drift = f", growing by {1e3 * self.drift:+.2f} ms each second" if self.drift else ""
        return f"(standard error {1e3 * self.error:.2g} ms, correlation {self.correlation:.2f}){drift}"


def estimate_offset(a: tuple[np.ndarray, np.ndarray], b: tuple[np.ndarray, np.ndarray]) -> Offset:
    """Offset of stream b behind stream a; both (k, m) with the same m, columns in the same order, units free.

    Raises DataError where there is too little common data or nothing moves.
    """
    a, b = as_stream(a, "first stream"), as_stream(b, "second stream")
    rate = min(1 / period_of(a.t), 1 / period_of(b.t), 100.0)  # Hz, of the common clock
    common = resample({"a": a, "b": b}, rate, quaternions=(), least=2 * LARGEST)
    reach = int(np.ceil(LARGEST * rate)) + 1
    pieces = [
        tuple(_in_band(common.values[name][rows], rate) for name in "ab")
        for rows in (np.flatnonzero(common.segment == k) for k in np.unique(common.segment))
        if len(rows) > 4 * reach
    ]
    if not pieces:
        raise DataError(f"less than {4 * LARGEST:g} s of common data: no offset can be estimated")
    sums, shortest = _sums(pieces, reach)
    total = sums.sum(axis=0)
    if not (total[1].max() > 0 and total[2].max() > 0):
        raise DataError("one of the streams does not move: no offset can be estimated")
    seconds, height, rival, at_edge = _peak(total, rate)
    error, agrees = np.inf, False
    if shortest >= BLOCK * rate:  # else all of it is in a moment or two
        rest = [_peak(total - stretch, rate)[0] for stretch in sums]
        alone = np.array([_peak(stretch, rate)[0] for stretch in sums])
        error = float(np.sqrt((len(rest) - 1) * np.var(rest)))
        agrees = np.mean(np.abs(alone - seconds) < 4 * np.sqrt(len(rest)) * error + 0.002) > 0.7
    clear = height > LEAST_CORRELATION and rival < AMBIGUOUS and not at_edge
    certain = clear and agrees and error < LARGEST_ERROR and abs(seconds) <= LARGEST
    return Offset(seconds, error, height, rival, bool(certain))


def _in_band(values: np.ndarray, rate: float) -> np.ndarray:
    """Between SLOWEST and BAND, (k, m), no phase lost; constants and lines go to zero."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.signal import detrend

    rounding = 1e-10 * np.abs(values).max(initial=0.0)
    scale = np.sqrt(np.log(2)) / (2 * np.pi) * rate  # over frequency: of a Gaussian 3 dB down there, in samples
    values = gaussian_filter1d(detrend(values, axis=0), scale / BAND, axis=0)
    # 1 - G is 3 dB down where G is 0.293
    slow = scale * np.sqrt(2 * np.log(1 / (1 - np.sqrt(0.5))) / np.log(2)) / SLOWEST
    values = values - gaussian_filter1d(values, slow, axis=0, truncate=3.0)
    return np.where(np.abs(values) > rounding, values, 0.0)


def _sums(pieces: list[tuple[np.ndarray, ...]], reach: int) -> tuple[np.ndarray, int]:
    """sum <a, b>, sum |a|^2 and sum |b|^2 by lag, (STRETCHES, 3, lags), of stretches that tell alike much; and the
    number of samples in the shortest stretch."""
    from scipy.signal import correlate

    slopes = [np.sum(np.gradient(x, axis=0)[reach:-reach] ** 2, axis=1) for x, _ in pieces]
    telling = np.cumsum(np.concatenate(slopes))
    number = np.minimum((telling / max(telling[-1], 1e-300) * STRETCHES * 0.999999).astype(int), STRETCHES - 1)
    sums, first = np.zeros((STRETCHES, 3, 2 * reach + 1)), 0
    for x, y in pieces:
        energy = np.concatenate([[0.0], np.cumsum(np.sum(y * y, axis=1))])
        inside = number[first : first + len(x) - 2 * reach]
        first += len(inside)
        for k in np.unique(inside):
            start, stop = np.searchsorted(inside, [k, k + 1])
            chosen, around = x[start + reach : stop + reach], y[start : stop + 2 * reach]
            sums[k, 0] += sum(
                correlate(b, a, mode="valid", method="fft") for a, b in zip(chosen.T, around.T, strict=True)
            )
            sums[k, 1] += np.sum(chosen**2)
            sums[k, 2] += (energy[stop - start :] - energy[: start - stop])[start : start + 2 * reach + 1]
    return sums, int(np.bincount(number, minlength=STRETCHES).min())


def _peak(sums: np.ndarray, rate: float) -> tuple[float, float, float, bool]:
    """Of the correlation: place (s), height, share of the next highest peak, whether it lies at the edge."""
    from scipy.interpolate import CubicSpline

    dot, aa, bb = sums
    correlation = dot / np.sqrt(np.maximum(aa * np.maximum(bb, 1e-12 * bb.max()), 1e-300))
    lags = (np.arange(len(dot)) - len(dot) // 2) / rate
    curve = CubicSpline(lags, correlation)
    slopes = curve.derivative()
    roots = [root for root in slopes.roots(extrapolate=False) if np.isfinite(root)]
    peaks = [r for r in roots if slopes(r, 1) < 0] or [float(lags[np.argmax(correlation)])]
    heights = np.array([float(curve(r)) for r in peaks])
    best = int(np.argmax(heights))
    others = np.delete(heights, best)
    rival = float(max(0.0, others.max() / heights[best])) if len(others) and heights[best] > 0 else 0.0
    return float(peaks[best]), float(heights[best]), rival, bool(correlation.max() > heights[best] + 1e-6)


def drifting(a: Stream, b: Stream) -> Offset | None:
    """Offset of b behind a that grows with time; None where it does not."""
    from scipy.stats import theilslopes

    begin, end = max(a.t[0], b.t[0]) + LARGEST, min(a.t[-1], b.t[-1]) - LARGEST
    count = min(int((end - begin) / WINDOW), MOST_WINDOWS)
    if count < LEAST_WINDOWS:
        return None
    known: list[Offset] = []
    middles: list[float] = []
    for middle in np.linspace(begin + WINDOW / 2, end - WINDOW / 2, count):
        before = known[-1].seconds if known else 0.0
        if len(known) > 1:
            slope = (known[-1].seconds - known[0].seconds) / (middles[-1] - middles[0])
            before += slope * (middle - middles[-1])
        near = np.abs(a.t - middle) < WINDOW / 2 + LARGEST
        other = np.abs(b.t - before - middle) < WINDOW / 2 + LARGEST
        try:
            offset = estimate_offset((a.t[near], a.values[near]), (b.t[other] - before, b.values[other]))
        except DataError:
            continue
        if offset.correlation > LEAST_CORRELATION and offset.rival < AMBIGUOUS and abs(offset.seconds) < LARGEST:
            known.append(offset._replace(seconds=offset.seconds + before))
            middles.append(float(middle))
    if len(known) < LEAST_WINDOWS:
        return None
    t, tau = np.array(middles), np.array([offset.seconds for offset in known])
    slope, _, low, high = theilslopes(tau, t, 0.95)
    middle = (begin + end) / 2
    level = float(np.median(tau - slope * (t - middle)))
    beside = tau - level - slope * (t - middle)
    if abs(slope) < LEAST_DRIFT or low * high <= 0 or np.median(np.abs(beside)) > AROUND_LINE:
        return None
    if np.ptp(slope * t) < 4 * np.median(np.abs(beside)):
        return None
    errors, around = np.array([offset.error for offset in known]), t - t.mean()
    scatter = np.sqrt(np.sum(beside**2) / (len(known) - 2))
    stated = errors[np.isfinite(errors)]  # others are of stretches in which it moved for a moment only
    errors[~np.isfinite(errors)] = stated.max(initial=0.0)
    of_slope = np.hypot(np.linalg.norm(around * errors), scatter * np.linalg.norm(around)) / np.sum(around**2)
    if not abs(slope) > SURELY * of_slope:
        return None
    error = float(np.hypot(np.linalg.norm(errors) / len(known), scatter / np.sqrt(len(known))))
    correlation = float(np.median([offset.correlation for offset in known]))
    return Offset(level, error, correlation, 0.0, True, float(slope), middle)


# ----------------------------------------------------------------------------------------------- streams of a flight
def find_offsets(streams: Mapping[str, Stream]) -> dict[tuple[str, str], Offset]:
    """(stream, behind which) -> offset; those that cannot be estimated are left out."""
    parts = {name: spread(stream) for name, stream in streams.items() if len(stream.t) >= LEAST_SAMPLES}
    offsets: dict[tuple[str, str], Offset] = {}
    for name, source, correlation in PAIRS:
        known = source == "position" and ("acceleration", "velocity") in offsets
        if known or not {name, source} <= parts.keys():
            continue
        try:
            offset = drifting(*_compared(name, source, streams)) or estimate_offset(*_compared(name, source, parts))
        except (DataError, ValueError, np.linalg.LinAlgError):
            continue
        offsets[name, source] = offset._replace(certain=offset.certain and offset.correlation > correlation)
    return offsets


def aligned(streams: Mapping[str, Stream], offsets: Mapping[tuple[str, str], Offset]) -> dict[str, Stream]:
    """The streams that are late or early, on the clock of the others, by the offsets that are certain.

    An offset does not say which of its two streams is late. Those of gyro and accelerometer that are behind are moved,
    and where these are ahead, attitude, position and velocity: a stream can be late, but not early, and commands of the
    motors are on the clock of the one that is not. Unless the specific force turned into the world fits the motion
    better with others moved.
    """
    named = {name: offset for (name, _), offset in offsets.items() if offset.certain}
    first = [("position", named["position"], -1.0)] if "position" in named else []
    of_rate = [("rate", -1.0)] if "rate" in named else []
    of_force = [("acceleration", -1.0)] if "acceleration" in named else []
    others = [[("attitude", 1.0), *of_force]] if of_rate else []
    others += [[*of_rate, ("velocity", 1.0), ("position", 1.0)]] if of_force else []
    shifts = []
    for chosen in ([*of_rate, *of_force], *others):
        moves = [
            (name, named["rate" if name in ("rate", "attitude") else "acceleration"], sign) for name, sign in chosen
        ]
        shifts.append(_moved(streams, [*first, *moves]))
    misfits = [_misfit(shift) for shift in shifts]
    best = min(range(len(shifts)), key=misfits.__getitem__)
    if misfits[best] < CLEARLY * misfits[0]:
        return shifts[best]
    known = [named[name].seconds for name in ("rate", "acceleration") if name in named]
    if not known or max(known) > 0:
        return shifts[0]
    motion = [("attitude", 1.0)] if of_rate else []
    motion += [("velocity", 1.0), ("position", 1.0)] if of_force else []
    moves = [(name, named["rate" if name == "attitude" else "acceleration"], sign) for name, sign in motion]
    return _moved(streams, [*first, *moves])


def _moved(streams: Mapping[str, Stream], moves: list[tuple[str, Offset, float]]) -> dict[str, Stream]:
    moved = dict(streams)
    for name, offset, sign in moves:
        if name in moved:
            t, values = moved[name]
            moved[name] = Stream(t + sign * offset.at(t), values)
    return moved


def _misfit(streams: Mapping[str, Stream]) -> float:
    """Root mean square of R f less the acceleration of the motion (m/s^2); 0 where it is not known."""
    from scipy.spatial.transform import Rotation

    motion = streams.get("velocity") or streams.get("position")
    if motion is None or not {"attitude", "acceleration"} <= streams.keys():
        return 0.0
    motion = spread(motion)
    slopes = _slopes(motion) if "velocity" in streams else _slopes(_slopes(motion))
    (t, f), attitude = streams["acceleration"], streams["attitude"]
    q = np.stack([np.interp(t, attitude.t, column) for column in continuous(attitude.values).T], axis=-1)
    pushed = Rotation.from_quat(q, scalar_first=True).apply(f)
    seen = np.stack([np.interp(slopes.t, t, column) for column in pushed.T], axis=-1)
    gap = _in_band(seen - slopes.values - [0.0, 0.0, GRAVITY], 1 / period_of(slopes.t))
    return float(np.sqrt(np.mean(gap**2)))


def spread(stream: Stream) -> Stream:
    """All of a short stream, stretches spread over a long one."""
    t, values = stream
    length = float(t[-1] - t[0])
    if length <= PARTS * PART:
        return stream
    kept = ((t - t[0]) / length * PARTS) % 1.0 * length / PARTS < PART
    return Stream(t[kept], values[kept])


def _turning(attitude: Stream) -> Stream:
    """Body rate (rad/s) of an attitude (k, 4), between samples without a gap."""
    return _between(attitude.t, attitude_rate(*attitude))


def turning_offset(attitude: Stream, rate: Stream) -> Offset | None:
    """Offset of body rates behind an attitude by their sizes, which need no common frame."""
    try:
        return estimate_offset(_size(_turning(spread(attitude))), _size(spread(rate)))
    except DataError:
        return None


def _compared(name: str, source: str, streams: Mapping[str, Stream]) -> tuple[Stream, Stream]:
    """What a stream shall follow, and what is compared with it."""
    late, early = streams[name], streams[source]
    if name == "rate":
        return _turning(early), late
    if name == "position":
        return early, _slopes(late)
    # Sizes do not depend on the attitude, whose own delay would turn gravity into a force along x and y.
    motion = _slopes(early) if source == "velocity" else _slopes(_slopes(early))
    return _size(Stream(motion.t, motion.values + [0.0, 0.0, GRAVITY])), _size(late)


def _slopes(stream: Stream) -> Stream:
    """Rate of change, between samples without a gap."""
    return _between(stream.t, np.diff(stream.values, axis=0) / np.diff(stream.t)[:, None])


def _between(t: np.ndarray, values: np.ndarray) -> Stream:
    near = np.diff(t) < 3.5 * period_of(t)
    return Stream(((t[1:] + t[:-1]) / 2)[near], values[near])


def _size(stream: Stream) -> Stream:
    return Stream(stream.t, np.linalg.norm(stream.values, axis=1, keepdims=True))
