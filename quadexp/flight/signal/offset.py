"""Time offset between two streams of the same quantity: cross-correlation, peak to a fraction of a sample, error.

    tau = argmax_tau  sum_j <a_j(t), b_j(t + tau)> / sqrt(sum_j |a_j|^2 sum_j |b_j|^2)

A positive offset: what `a` shows at t, `b` shows at t + tau, so b's clock is to be moved back by tau. Both streams are
brought to one clock and to one band (a Gaussian low-pass, without phase: motion lives below it, noise above it has
nothing to say); columns are freed of their means. The peak is that of a cubic spline through the correlation at whole
samples; the standard error is that of the linearised fit, with the residual summed over blocks of half a second (it is
not white).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.flight.signal.resample import resample
from quadexp.flight.signal.stream import Stream, as_stream, period

BAND = 10.0  # Hz, -3 dB
BLOCK = 0.5  # s
LEAST_CORRELATION = 0.5
AMBIGUOUS = 0.97  # another peak as high as this share of the highest one


class Offset(NamedTuple):
    """seconds: of b behind a. error: its standard error (s). correlation: at the peak, -1..1. gain: of b over a.

    rival: height of the next peak over that of the first (near 1: periodic motion, cannot tell). certain: correlation
    above LEAST_CORRELATION, no rival, error below a fifth of the largest offset looked for, peak not at the edge.
    """

    seconds: float
    error: float
    correlation: float
    gain: float
    rival: float
    certain: bool


def estimate_offset(
    a: Stream | tuple[np.ndarray, np.ndarray],
    b: Stream | tuple[np.ndarray, np.ndarray],
    *,
    largest: float = 0.5,
    rate: float | None = None,
    band: float = BAND,
) -> Offset:
    """Offset of stream b behind stream a; both (k, m) with the same m, columns in the same order, units free.

    largest: largest offset looked for (s). rate: of the common clock (Hz); default: the slower stream's, at most 100.
    band: of the low-pass (Hz).
    Raises DataError where there is too little common data or nothing moves.
    """
    a, b = as_stream(a, "first stream"), as_stream(b, "second stream")
    if a.values.shape[1] != b.values.shape[1]:
        raise DataError(f"streams of {a.values.shape[1]} and {b.values.shape[1]} columns cannot be correlated")
    rate = rate or min(1 / period(a.t), 1 / period(b.t), 100.0)
    common = resample({"a": a, "b": b}, rate, quaternions=(), least=2 * largest)
    reach = int(np.ceil(largest * rate)) + 1
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import gaussian_filter1d
    from scipy.signal import correlate

    width = np.sqrt(np.log(2)) / (2 * np.pi * band) * rate  # of a Gaussian that is 3 dB down at `band`, in samples
    pieces = [
        tuple(gaussian_filter1d(common.values[name][rows], width, axis=0) for name in "ab")
        for rows in (np.flatnonzero(common.segment == k) for k in np.unique(common.segment))
        if len(rows) > 4 * reach
    ]
    if not pieces:
        raise DataError(f"less than {4 * largest:g} s of common data: no offset can be estimated")
    lags = np.arange(-reach, reach + 1)
    dot, aa, bb = np.zeros(len(lags)), np.zeros(len(lags)), np.zeros(len(lags))
    for x, y in pieces:
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
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
    tau = float(peaks[best])
    others = np.delete(heights, best)
    rival = float(max(0.0, others.max() / heights[best])) if len(others) and heights[best] > 0 else 0.0
    error, gain = _error(pieces, tau, rate, reach)
    edge = abs(tau) > largest or correlation.max() > heights[best] + 1e-6
    certain = heights[best] > LEAST_CORRELATION and rival < AMBIGUOUS and error < 0.2 * largest and not edge
    return Offset(tau, error, float(heights[best]), gain, rival, bool(certain))


def _error(pieces, tau: float, rate: float, reach: int) -> tuple[float, float]:
    """Standard error of tau and gain of b over a, from the residual b(t + tau) - gain a(t) against its derivative."""
    from scipy.interpolate import CubicSpline

    block = max(1, int(BLOCK * rate))
    xs, ys, x_slopes, y_slopes, label = [], [], [], [], []
    for x, y in pieces:
        n = np.arange(reach, len(x) - reach)
        at = n + tau * rate
        x_spline, y_spline = (CubicSpline(np.arange(len(z)), z - z.mean(axis=0)) for z in (x, y))
        xs.append(x_spline(n))
        ys.append(y_spline(at))
        x_slopes.append(x_spline(n, 1) * rate)
        y_slopes.append(y_spline(at, 1) * rate)
        label.append(n // block + 1_000_000 * len(label))
    x, y, x_slope, y_slope = map(np.concatenate, (xs, ys, x_slopes, y_slopes))
    gain = float(np.sum(x * y) / np.sum(x * x))
    _, group = np.unique(np.concatenate(label), return_inverse=True)
    score = np.bincount(group, weights=np.sum((y - gain * x) * (gain * x_slope + y_slope) / 2, axis=1))
    curvature = gain * np.sum(x_slope * y_slope)  # of two different noises, which adds nothing to it
    return (float(np.sqrt(np.sum(score**2)) / curvature) if curvature > 0 else np.inf), gain
