"""A signal on its own clock: irregular times, values side by side, gaps; and its derivative on a uniform one.

A gap is a step of the clock longer than `GAP_PERIODS` of the stream's own period (the median step): a few samples lost
on a radio link are bridged, a stretch without data is not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.log.runs import runs
from quadexp.physics.state import finite_rows

GAP_PERIODS = 5.0  # of the stream; what is shorter is interpolated over
ORDER = 3  # of the polynomial whose derivative is taken


class Stream(NamedTuple):
    """t: (k,) s, strictly increasing. values: (k, m)."""

    t: np.ndarray
    values: np.ndarray


def as_stream(stream: Stream | tuple[np.ndarray, np.ndarray], name: str = "stream") -> Stream:
    """The stream with a (k, m) array of floats, rows that are not finite left out.

    Raises DataError where fewer than two rows are left, or the clock does not increase.
    """
    t = np.asarray(stream[0], float)
    values = np.asarray(stream[1], float).reshape(len(t), -1)
    finite = np.isfinite(t) & finite_rows(values)
    if not finite.all():
        t = t[finite]
        values = values[finite]
    if len(t) < 2:
        raise DataError(f"{name}: {len(t)} finite rows, two at least are needed")
    steps = np.diff(t)
    if steps.min() <= 0:
        row = int(np.argmin(steps > 0))
        went = f"the clock goes from {t[row]:.6f} to {t[row + 1]:.6f} s at row {row}"
        raise DataError(f"{name}: {went}: it must increase")
    return Stream(t, values)


def increasing(t: np.ndarray) -> np.ndarray:
    """Mask of the rows, (k,), that lie later than every row before them: what is left is strictly increasing."""
    t = np.asarray(t, float)
    filled = np.where(np.isfinite(t), t, -np.inf)
    latest = np.maximum.accumulate(filled)
    before = np.concatenate([[-np.inf], latest[:-1]])
    return filled > before


def stretches(t: np.ndarray, gap: float) -> list[slice]:
    """The rows between the gaps: maximal runs without a step longer than `gap` (s), single rows left out."""
    return [slice(start, stop + 1) for start, stop in runs(np.diff(t) <= gap)]


def numbered(segment: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Numbers, from 0 on, of the uninterrupted stretches of the rows kept, of which a segment (k,) may have several."""
    parts = np.column_stack([segment, np.cumsum(~kept)])[kept]
    return np.unique(parts, axis=0, return_inverse=True)[1].ravel().astype(np.int32)


class Derivative(NamedTuple):
    """values: (k, m), the signal's unit per second. bandwidth: Hz, -3 dB."""

    values: np.ndarray
    bandwidth: float


def derivative(
    t: np.ndarray, values: np.ndarray, *, window: float = 0.15, segment: np.ndarray | None = None
) -> Derivative:
    """Derivative of values (k,) or (k, m) on a clock t (k,) that is uniform within each segment (k,), of Savitzky
    and Golay.

    A cubic is fitted to every window of samples and differentiated at its middle; up to the bandwidth stated (where the
    gain has fallen to 1/sqrt(2) of i omega) the result is the derivative, above it noise is damped. No phase is lost.
    window: length of the fit (s); at least five samples are taken. Segments too short for it get a shorter window.
    Raises DataError where the clock is not uniform.
    """
    from scipy.signal import savgol_filter

    t = np.asarray(t, float)
    values = np.asarray(values, float)
    segment = np.zeros(len(t), int) if segment is None else np.asarray(segment)
    inside = np.diff(segment) == 0
    steps = np.diff(t)
    if not inside.any():
        raise DataError("no segment has two samples: there is no derivative")
    dt = float(np.median(steps[inside]))
    off = inside & (np.abs(steps - dt) > 1e-3 * dt)
    if dt <= 0 or off.any():
        row = int(np.argmax(off))
        raise DataError(f"the clock steps by {steps[row]:.6g} s at row {row}, by {dt:.6g} s elsewhere: resample first")
    length = max(5, int(round(window / dt)) | 1)
    out = np.full(values.shape, np.nan)
    for rows in np.split(np.arange(len(t)), np.flatnonzero(~inside) + 1):
        fitted = min(length, len(rows) - 1 | 1)
        if len(rows) >= 5:
            out[rows] = savgol_filter(values[rows], fitted, ORDER, deriv=1, delta=dt, axis=0)
        elif len(rows) > 1:
            out[rows] = np.gradient(values[rows], dt, axis=0)
    return Derivative(out, bandwidth(length, dt))


def bandwidth(length: int, dt: float) -> float:
    """Frequency (Hz) where the gain of the filter of `length` samples falls to 1/sqrt(2) of the derivative's."""
    from scipy.signal import savgol_coeffs

    taps = savgol_coeffs(length, ORDER, deriv=1, delta=dt, use="dot")
    offsets = (np.arange(length) - length // 2) * dt
    frequency = np.linspace(1e-4, 0.5, 4000) / dt
    omega = 2 * np.pi * frequency
    gain = (np.sin(np.outer(omega, offsets)) @ taps) / omega
    below = frequency[gain < np.sqrt(0.5)]
    return float(below[0] if len(below) else frequency[-1])
