"""Time offsets between what moves alike: gyro against the attitude's turning, accelerometer against velocity.
Cross-correlation, then a fit with a standard error:

    tau = argmax_tau  sum_j <a_j(t), b_j(t + tau)> / sqrt(sum_j |a_j|^2 sum_j |b_j|^2)

A positive offset: what `a` shows at t, `b` shows at t + tau, so b's clock is to be moved back by tau. Both streams are
brought to one clock and to one band (Gaussian low- and high-pass, without phase): above it noise dominates, below it
drift and drag shift the phase of a slow signal without any delay. The peak of the correlation is refined by

    b(t + tau) = g a(t) + k a'(t),      tau <- tau - k / g   until k = 0,

with (g a' + b') / 2 as instrument of a' and sum a' b' as its curvature, so that noise in neither shortens k. The
standard error is the larger one of a sandwich over blocks of half a second (the residual is not white) and of a
jackknife over stretches of the log. Offsets are reported only; moving a stream is asked for (`--align`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.log.signal.resample import resample
from quadexp.log.signal.stream import Stream, as_stream, period
from quadexp.log.signal.windows import attitude_rate
from quadexp.physics.vehicle import GRAVITY

LARGEST = 0.5  # s
BAND = 4.0  # Hz, -3 dB: vehicles turn slower, motion capture shakes faster
SLOWEST = 0.25  # Hz, -3 dB
BLOCK = 0.5  # s
STRETCHES = 6
ROUNDS = 8
LEAST_CORRELATION = 0.5
AMBIGUOUS = 0.97  # another peak as high as this share of the highest one
LARGEST_ERROR = 0.02  # s
LEAST_SAMPLES = 50
# Which stream is compared with which other one, and with what correlation: an accelerometer feels more than the motion.
PAIRS = (("rate", "attitude", 0.7), ("acceleration", "velocity", 0.9), ("acceleration", "position", 0.9))
PARTS, PART = 6, 20.0  # how many stretches of a long flight are looked at, and how long (s)


class Offset(NamedTuple):
    """seconds: of b behind a. error: its standard error (s). correlation: at the peak, -1..1. gain: of b over a.

    rival: height of the next peak over that of the first (near 1: periodic motion, cannot tell). certain: correlation
    above LEAST_CORRELATION, no rival, a small error, stretches of the log that agree, peak not at the edge.
    """

    seconds: float
    error: float
    correlation: float
    gain: float
    rival: float
    certain: bool


def estimate_offset(
    a: tuple[np.ndarray, np.ndarray],
    b: tuple[np.ndarray, np.ndarray],
) -> Offset:
    """Offset of stream b behind stream a; both (k, m) with the same m, columns in the same order, units free.

    Raises DataError where there is too little common data or nothing moves.
    """
    a, b = as_stream(a, "first stream"), as_stream(b, "second stream")
    if a.values.shape[1] != b.values.shape[1]:
        raise DataError(f"streams of {a.values.shape[1]} and {b.values.shape[1]} columns cannot be correlated")
    rate = min(1 / period(a.t), 1 / period(b.t), 100.0)  # Hz, of the common clock
    common = resample({"a": a, "b": b}, rate, quaternions=(), least=2 * LARGEST)
    reach = int(np.ceil(LARGEST * rate)) + 1
    pieces = [
        tuple(_in_band(common.values[name][rows], rate) for name in "ab")
        for rows in (np.flatnonzero(common.segment == k) for k in np.unique(common.segment))
        if len(rows) > 4 * reach
    ]
    if not pieces:
        raise DataError(f"less than {4 * LARGEST:g} s of common data: no offset can be estimated")
    peak, height, rival, at_edge = _peak(pieces, reach, rate)
    fit = _refined(pieces, peak, reach, rate)
    clear = height > LEAST_CORRELATION and rival < AMBIGUOUS and not at_edge
    certain = clear and fit.agrees and fit.error < LARGEST_ERROR and abs(fit.seconds) <= LARGEST
    return Offset(fit.seconds, fit.error, height, fit.gain, rival, bool(certain))


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


def _peak(pieces: list[tuple[np.ndarray, ...]], reach: int, rate: float) -> tuple[float, float, float, bool]:
    """Of the correlation: place (s), height, share of the next highest peak, whether it lies at the edge."""
    from scipy.interpolate import CubicSpline
    from scipy.signal import correlate

    lags = np.arange(-reach, reach + 1)
    dot, aa, bb = np.zeros((3, len(lags)))
    for x, y in pieces:
        core = slice(reach, len(x) - reach)
        dot += sum(correlate(y[:, j], x[core, j], mode="valid", method="fft") for j in range(x.shape[1]))
        energy = np.concatenate([[0.0], np.cumsum(np.sum(y * y, axis=1))])
        bb += energy[len(x) - 2 * reach :] - energy[: 2 * reach + 1]
        aa += np.sum(x[core] ** 2)
    if not (aa[0] > 0 and bb.max() > 0):
        raise DataError("one of the streams does not move: no offset can be estimated")
    correlation = dot / np.sqrt(aa * np.maximum(bb, 1e-12 * bb.max()))
    curve = CubicSpline(lags / rate, correlation)
    slopes = curve.derivative()
    roots = [root for root in slopes.roots(extrapolate=False) if np.isfinite(root)]
    peaks = [r for r in roots if slopes(r, 1) < 0] or [float(lags[np.argmax(correlation)] / rate)]
    heights = np.array([float(curve(r)) for r in peaks])
    best = int(np.argmax(heights))
    others = np.delete(heights, best)
    rival = float(max(0.0, others.max() / heights[best])) if len(others) and heights[best] > 0 else 0.0
    return float(peaks[best]), float(heights[best]), rival, bool(correlation.max() > heights[best] + 1e-6)


class _Fit(NamedTuple):
    seconds: float
    error: float
    gain: float
    agrees: bool


def _refined(pieces: list[tuple[np.ndarray, ...]], tau: float, reach: int, rate: float) -> _Fit:
    """The offset at which b no longer correlates with the derivative of `a`, from the peak of the correlation on."""
    start, gain = tau, 1.0
    for _ in range(ROUNDS):
        tau = float(np.clip(tau, start - 0.5 * reach / rate, start + 0.5 * reach / rate))
        tau = float(np.clip(tau, -(reach - 1) / rate, (reach - 1) / rate))
        bread, meat = _normal_equations(pieces, tau, reach, rate, gain)
        beta = _solve(bread.sum(axis=0), meat.sum(axis=0))
        if beta is None or not beta[0]:
            return _Fit(start, np.inf, 0.0, False)
        gain, step = float(beta[0]), float(beta[1] / beta[0])
        tau -= step
        if abs(step) < 1e-6:
            break
    total = bread.sum(axis=0)
    scores = meat - bread @ beta
    covariance = np.linalg.solve(total, np.linalg.solve(total, scores.T @ scores).T)
    sandwich = float(np.sqrt(max(covariance[1, 1], 0.0)) / abs(gain))
    jackknife, agrees = _jackknife(bread, meat, sandwich)
    return _Fit(tau, max(sandwich, jackknife), gain, agrees)


def _normal_equations(
    pieces: list[tuple[np.ndarray, ...]], tau: float, reach: int, rate: float, gain: float
) -> tuple[np.ndarray, np.ndarray]:
    """Instruments times regressors (blocks, n, n), and times b (blocks, n), summed over blocks."""
    from scipy.interpolate import CubicSpline

    length = max(1, int(BLOCK * rate))
    breads, meats = [], []
    for x, y in pieces:
        n = np.arange(reach, len(x) - reach)
        x_slope = CubicSpline(np.arange(len(x)), x)(n, 1) * rate
        y_spline = CubicSpline(np.arange(len(y)), y)
        ys, y_slope = y_spline(n + tau * rate), y_spline(n + tau * rate, 1) * rate
        regressors = np.stack([x[n], x_slope], axis=-1)
        instruments = regressors.copy()
        instruments[..., 1] = (x_slope + y_slope / (gain or 1.0)) / 2
        edges = np.arange(0, len(n), length)
        products = np.einsum("kmi,kmj->kij", instruments, regressors)
        products[:, 1, 1] = np.sum(x_slope * y_slope, axis=1) / (gain or 1.0)
        breads.append(np.add.reduceat(products, edges))
        meats.append(np.add.reduceat(np.einsum("kmi,km->ki", instruments, ys), edges))
    return np.concatenate(breads), np.concatenate(meats)


def _solve(bread: np.ndarray, meat: np.ndarray) -> np.ndarray | None:
    scale = np.sqrt(np.abs(np.diag(bread)))
    if not (scale > 0).all() or np.linalg.cond(bread / np.outer(scale, scale)) > 1e8:
        return None
    return np.linalg.solve(bread, meat)


def _jackknife(bread: np.ndarray, meat: np.ndarray, error: float) -> tuple[float, bool]:
    """Error (s) from leaving out one stretch after the other, each with its share of what tells the offset; and
    whether what every one of them says by itself is the same."""
    telling = np.cumsum(np.maximum(bread[:, 1, 1], 0))
    number = np.minimum((telling / telling[-1] * STRETCHES * 0.999999).astype(int), STRETCHES - 1)
    stretches = np.unique(number)
    count = len(stretches)

    def offsets(chosen: list[np.ndarray]) -> list[float]:
        fits = [_solve(bread[blocks].sum(axis=0), meat[blocks].sum(axis=0)) for blocks in chosen]
        return [float(beta[1] / beta[0]) for beta in fits if beta is not None and beta[0]]

    rest, alone = offsets([number != k for k in stretches]), offsets([number == k for k in stretches])
    if min(len(rest), len(alone)) < max(3, count - 1):  # all of it in a moment or two
        return np.inf, False
    spread = float(np.sqrt((count - 1) / count * np.var(rest) * len(rest)))
    limit = 4 * np.sqrt(count) * max(error, spread) + 0.002
    return spread, bool(np.mean(np.abs(alone) < limit) > 0.7)


# ----------------------------------------------------------------------------------------------- streams of a flight
def find_offsets(streams: Mapping[str, Stream]) -> dict[tuple[str, str], Offset]:
    """(stream, behind which) -> offset; those that cannot be estimated are left out."""
    parts = {name: spread(stream) for name, stream in streams.items() if len(stream.t) >= LEAST_SAMPLES}
    offsets: dict[tuple[str, str], Offset] = {}
    for name, source, correlation in PAIRS:
        if ("acceleration", "velocity") in offsets or not {name, source} <= parts.keys():
            continue
        try:
            offset = estimate_offset(*_compared(name, source, parts))
        except (DataError, ValueError, np.linalg.LinAlgError):
            continue
        offsets[name, source] = offset._replace(certain=offset.certain and offset.correlation > correlation)
    return offsets


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
    # Sizes do not depend on the attitude, whose own delay would turn gravity into a force along x and y.
    motion = _slopes(early) if source == "velocity" else _slopes(_slopes(early))
    return _size(Stream(motion.t, motion.values + [0.0, 0.0, GRAVITY])), _size(late)


def _slopes(stream: Stream) -> Stream:
    """Rate of change, between samples without a gap."""
    return _between(stream.t, np.diff(stream.values, axis=0) / np.diff(stream.t)[:, None])


def _between(t: np.ndarray, values: np.ndarray) -> Stream:
    near = np.diff(t) < 3.5 * np.median(np.diff(t))
    return Stream(((t[1:] + t[:-1]) / 2)[near], values[near])


def _size(stream: Stream) -> Stream:
    return Stream(stream.t, np.linalg.norm(stream.values, axis=1, keepdims=True))
