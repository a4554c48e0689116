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

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.log.runs import period_of
from quadexp.physics.state import norms, root_mean_square
from quadexp.physics.vehicle import GRAVITY
from quadexp.plugins.logs.signal import Stream, as_stream
from quadexp.plugins.logs.signal.resample import interpolate, resample
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
PAIRS = (
    ("rate", "attitude", 0.7),
    ("acceleration", "velocity", 0.9),
    ("acceleration", "position", 0.9),
    ("position", "velocity", 0.9),
)
MOTION = {"rate": ("attitude",), "acceleration": ("velocity", "position")}  # what a sensor is moved against
WINDOW = 8.0  # s, of a stretch on the line
MOST_WINDOWS = 24  # on a line
LEAST_WINDOWS = 4  # on a line
LEAST_DRIFT = 3e-4  # s/s: quartz keeps a tenth of that
CLEARLY = 0.8  # of the misfit, below which the other side is taken to be late
SURELY = 5.0  # standard errors of a drift, of the stretches' own and of their scatter about the line
AROUND_LINE = 0.01  # s: what offsets of stretches may lie beside a line
PARTS = 6  # stretches of a long flight that are looked at
PART = 20.0  # s, of one of them


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
    a = as_stream(a, "first stream")
    b = as_stream(b, "second stream")
    rate = min(1 / period_of(a.t), 1 / period_of(b.t), 100.0)  # Hz, of the common clock
    common = resample({"a": a, "b": b}, rate, quaternions=(), least=2 * LARGEST)
    reach = int(np.ceil(LARGEST * rate)) + 1
    pieces = []
    for number in np.unique(common.segment):
        rows = common.segment == number
        if rows.sum() > 4 * reach:
            pieces.append([_in_band(common.values[name][rows], rate) for name in "ab"])
    if not pieces:
        raise DataError(f"less than {4 * LARGEST:g} s of common data: no offset can be estimated")
    sums, shortest = _sums(pieces, reach)
    total = sums.sum(axis=0)
    if not total[1:].max(axis=1).min() > 0:
        raise DataError("one of the streams does not move: no offset can be estimated")
    seconds, height, rival, at_edge = _peak(total, rate)
    error = np.inf
    agrees = False
    if shortest >= BLOCK * rate:  # else all of it is in a moment or two
        without_one = [_peak(total - stretch, rate)[0] for stretch in sums]
        alone = np.array([_peak(stretch, rate)[0] for stretch in sums])
        error = float(np.sqrt((STRETCHES - 1) * np.var(without_one)))
        near = np.abs(alone - seconds) < 4 * np.sqrt(STRETCHES) * error + 0.002
        agrees = near.mean() > 0.7
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


def _sums(pieces: Sequence[Sequence[np.ndarray]], reach: int) -> tuple[np.ndarray, int]:
    """sum <a, b>, sum |a|^2 and sum |b|^2 by lag, (STRETCHES, 3, lags), of stretches that tell alike much; and the
    number of samples in the shortest stretch."""
    from scipy.signal import correlate

    slopes = [np.gradient(x, axis=0)[reach:-reach] for x, _ in pieces]
    telling = np.cumsum(np.sum(np.concatenate(slopes) ** 2, axis=1))
    share = telling / max(telling[-1], 1e-300)
    number = (share * STRETCHES * 0.999999).astype(int)
    sums = np.zeros((STRETCHES, 3, 2 * reach + 1))
    first = 0
    for x, y in pieces:
        inside = number[first : first + len(x) - 2 * reach]
        first += len(inside)
        for k in np.unique(inside):
            start, stop = np.searchsorted(inside, [k, k + 1])
            a = x[start + reach : stop + reach]
            b = y[start : stop + 2 * reach]
            for axis in range(a.shape[1]):
                sums[k, 0] += correlate(b[:, axis], a[:, axis], mode="valid", method="fft")
            sums[k, 1] += np.sum(a**2)
            energy = np.concatenate([[0.0], np.cumsum(np.sum(b * b, axis=1))])
            sums[k, 2] += energy[stop - start :] - energy[: start - stop]
    return sums, int(np.bincount(number, minlength=STRETCHES).min())


def _peak(sums: np.ndarray, rate: float) -> tuple[float, float, float, bool]:
    """Of the correlation: place (s), height, share of the next highest peak, whether it lies at the edge."""
    from scipy.interpolate import CubicSpline

    dot, aa, bb = sums
    bb = np.maximum(bb, 1e-12 * bb.max())
    correlation = dot / np.sqrt(np.maximum(aa * bb, 1e-300))
    lags = (np.arange(len(dot)) - len(dot) // 2) / rate
    curve = CubicSpline(lags, correlation)
    flat = curve.derivative().roots(extrapolate=False)
    peaks = [lag for lag in flat[np.isfinite(flat)] if curve(lag, 2) < 0]
    if not peaks:
        peaks = [lags[np.argmax(correlation)]]
    *lower, (height, place) = sorted((float(curve(lag)), float(lag)) for lag in peaks)
    rival = lower[-1][0] / height if lower and height > 0 else 0.0
    return place, height, max(0.0, rival), bool(correlation.max() > height + 1e-6)


def drifting(a: Stream, b: Stream) -> Offset | None:
    """Offset of b behind a that grows with time; None where it does not."""
    from scipy.stats import theilslopes

    begin = max(a.t[0], b.t[0]) + LARGEST
    end = min(a.t[-1], b.t[-1]) - LARGEST
    count = min(int((end - begin) / WINDOW), MOST_WINDOWS)
    if count < LEAST_WINDOWS:
        return None
    known: list[Offset] = []
    middles: list[float] = []
    for middle in np.linspace(begin + WINDOW / 2, end - WINDOW / 2, count):
        before = 0.0
        if known:
            before = known[-1].seconds
        if len(known) > 1:
            slope = (known[-1].seconds - known[0].seconds) / (middles[-1] - middles[0])
            before += slope * (middle - middles[-1])
        try:
            offset = estimate_offset(_about(a, middle), _about(Stream(b.t - before, b.values), middle))
        except DataError:
            continue
        if offset.correlation > LEAST_CORRELATION and offset.rival < AMBIGUOUS and abs(offset.seconds) < LARGEST:
            known.append(offset._replace(seconds=offset.seconds + before))
            middles.append(float(middle))
    if len(known) < LEAST_WINDOWS:
        return None
    middle = (begin + end) / 2
    t = np.array(middles) - middle
    tau = np.array([offset.seconds for offset in known])
    slope, _, low, high = theilslopes(tau, t, 0.95)
    level = float(np.median(tau - slope * t))
    beside = tau - level - slope * t
    typical = np.median(np.abs(beside))
    grown = abs(slope) * np.ptp(t)
    if abs(slope) < LEAST_DRIFT or low * high <= 0 or typical > min(AROUND_LINE, grown / 4):
        return None
    errors = np.array([offset.error for offset in known])
    finite = np.isfinite(errors)  # others are of stretches in which it moved for a moment only
    errors[~finite] = errors[finite].max(initial=0.0)
    scatter = np.sqrt(np.sum(beside**2) / (len(known) - 2))
    around = t - t.mean()
    lever = around / np.sum(around**2)
    of_slope = np.hypot(np.linalg.norm(lever * errors), scatter * np.linalg.norm(lever))
    if not abs(slope) > SURELY * of_slope:
        return None
    error = float(np.hypot(np.linalg.norm(errors) / len(known), scatter / np.sqrt(len(known))))
    correlation = float(np.median([offset.correlation for offset in known]))
    return Offset(level, error, correlation, 0.0, True, float(slope), middle)


def _about(stream: Stream, middle: float) -> Stream:
    """A stretch of WINDOW seconds, and as much beside it as it may be late."""
    near = np.abs(stream.t - middle) < WINDOW / 2 + LARGEST
    return Stream(stream.t[near], stream.values[near])


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
            offset = drifting(*_compared(name, source, streams))
            if offset is None:
                offset = estimate_offset(*_compared(name, source, parts))
        except (DataError, ValueError, np.linalg.LinAlgError):
            continue
        certain = offset.certain and offset.correlation > correlation
        offsets[name, source] = offset._replace(certain=certain)
    return offsets


def aligned(streams: Mapping[str, Stream], offsets: Mapping[tuple[str, str], Offset]) -> dict[str, Stream]:
    """The streams that are late or early, on the clock of the others, by the offsets that are certain.

    An offset does not say which of its two streams is late. Those of gyro and accelerometer that are behind are moved,
    and where these are ahead, attitude, position and velocity: a stream can be late, but not early, and commands of the
    motors are on the clock of the one that is not. Unless the specific force turned into the world fits the motion
    better with others moved.
    """
    certain = {name: offset for (name, _), offset in offsets.items() if offset.certain}
    sensors = [name for name in MOTION if name in certain]
    shifts = [_shifted(streams, certain, ())]
    for name in sensors:
        shifts.append(_shifted(streams, certain, (name,)))
    misfits = [_misfit(shift) for shift in shifts]
    best = int(np.argmin(misfits))
    if misfits[best] < CLEARLY * misfits[0]:
        return shifts[best]
    if sensors and all(certain[name].seconds <= 0 for name in sensors):
        return _shifted(streams, certain, sensors)
    return shifts[0]


def _shifted(
    streams: Mapping[str, Stream], offsets: Mapping[str, Offset], others: Collection[str]
) -> dict[str, Stream]:
    """Streams moved by their offsets; in place of the sensors `others` the motion that these are compared with."""
    shifted = dict(streams)
    for sensor, offset in offsets.items():
        sign = -1.0
        moved: tuple[str, ...] = (sensor,)
        if sensor in others:
            sign = 1.0
            moved = MOTION[sensor]
        for name in moved:
            if name in shifted:
                t, values = shifted[name]
                shifted[name] = Stream(t + sign * offset.at(t), values)
    return shifted


def _misfit(streams: Mapping[str, Stream]) -> float:
    """Root mean square of R f less the acceleration of the motion (m/s^2); 0 where it is not known."""
    from scipy.spatial.transform import Rotation

    motion = streams.get("velocity") or streams.get("position")
    if motion is None or not {"attitude", "acceleration"} <= streams.keys():
        return 0.0
    slopes = _slopes(spread(motion))
    if "velocity" not in streams:
        slopes = _slopes(slopes)
    t, force = streams["acceleration"]
    q = interpolate(*streams["attitude"], t, sphere=True)
    push = Rotation.from_quat(q, scalar_first=True).apply(force)
    seen = interpolate(t, push, slopes.t)
    gap = seen - slopes.values - [0.0, 0.0, GRAVITY]
    return root_mean_square(_in_band(gap, 1 / period_of(slopes.t)))


def spread(stream: Stream) -> Stream:
    """All of a short stream, stretches spread over a long one."""
    t, values = stream
    length = float(t[-1] - t[0])
    if length <= PARTS * PART:
        return stream
    since = (t - t[0]) % (length / PARTS)
    kept = since < PART
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
    late = streams[name]
    early = streams[source]
    if name == "rate":
        return _turning(early), late
    if name == "position":
        return early, _slopes(late)
    # Sizes do not depend on the attitude, whose own delay would turn gravity into a force along x and y.
    motion = _slopes(early)
    if source == "position":
        motion = _slopes(motion)
    force = Stream(motion.t, motion.values + [0.0, 0.0, GRAVITY])
    return _size(force), _size(late)


def _slopes(stream: Stream) -> Stream:
    """Rate of change, between samples without a gap."""
    return _between(stream.t, np.diff(stream.values, axis=0) / np.diff(stream.t)[:, None])


def _between(t: np.ndarray, values: np.ndarray) -> Stream:
    near = np.diff(t) < 3.5 * period_of(t)
    middle = (t[1:] + t[:-1]) / 2
    return Stream(middle[near], values[near])


def _size(stream: Stream) -> Stream:
    return Stream(stream.t, norms(stream.values)[:, None])
