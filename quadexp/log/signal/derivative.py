"""Derivative of a sampled signal with a stated bandwidth: Savitzky-Golay, segment by segment.

A cubic is fitted to every window of samples and differentiated at its middle; up to the bandwidth stated (where the
gain has fallen to 1/sqrt(2) of i omega) the result is the derivative, above it noise is damped. No phase is lost.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError

ORDER = 3


class Derivative(NamedTuple):
    """values: (k, m), the signal's unit per second. bandwidth: Hz, -3 dB. window: s."""

    values: np.ndarray
    bandwidth: float
    window: float


def derivative(
    t: np.ndarray, values: np.ndarray, *, window: float = 0.15, segment: np.ndarray | None = None
) -> Derivative:
    """Derivative of values (k,) or (k, m) on a clock t (k,) that is uniform within each segment (k,).

    window: length of the fit (s); at least five samples are taken. Segments too short for it get a shorter window.
    Raises DataError where the clock is not uniform.
    """
    from scipy.signal import savgol_filter

    t, values = np.asarray(t, float), np.asarray(values, float)
    if len(t) < 2:
        raise DataError(f"{len(t)} samples have no derivative, two at least are needed")
    segment = np.zeros(len(t), int) if segment is None else np.asarray(segment)
    inside = np.diff(segment) == 0
    steps = np.diff(t)
    if not inside.any():
        raise DataError("no segment has two samples: there is no derivative")
    dt = float(np.median(steps[inside]))
    off = np.abs(steps - dt) > 1e-3 * dt
    if dt <= 0 or (off & inside).any():
        row = int(np.argmax(off & inside))
        raise DataError(f"the clock steps by {steps[row]:.6g} s at row {row}, by {dt:.6g} s elsewhere: resample first")
    length = max(5, int(round(window / dt)) | 1)
    out = np.full(values.shape, np.nan)
    bounds = np.concatenate([[0], np.flatnonzero(~inside) + 1, [len(t)]])
    for start, stop in zip(bounds[:-1], bounds[1:], strict=True):
        n = stop - start
        if n < 2:
            continue
        own = min(length, n if n % 2 else n - 1)
        if own >= 5:
            out[start:stop] = savgol_filter(values[start:stop], own, ORDER, deriv=1, delta=dt, axis=0)
        else:
            out[start:stop] = np.gradient(values[start:stop], dt, axis=0)
    return Derivative(out, bandwidth(length, dt), length * dt)


def bandwidth(length: int, dt: float) -> float:
    """Frequency (Hz) where the gain of the filter of `length` samples falls to 1/sqrt(2) of the derivative's."""
    from scipy.signal import savgol_coeffs

    taps = savgol_coeffs(length, ORDER, deriv=1, delta=dt, use="dot")
    offsets = (np.arange(length) - length // 2) * dt
    frequency = np.linspace(1e-4, 0.5, 4000) / dt
    omega = 2 * np.pi * frequency
    gain = (np.sin(np.outer(omega, offsets)) @ taps) / omega
    below = np.flatnonzero(gain < np.sqrt(0.5))
    return float(frequency[below[0]] if len(below) else frequency[-1])
