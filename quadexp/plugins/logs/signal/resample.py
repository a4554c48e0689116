"""Streams on clocks of their own, brought to one uniform clock without aliasing and without bridging gaps.

    x(t_k) = sum_n h(t_k - n / f) x_i(n / f),      t_k = t_0 + k / rate

x_i interpolates the stream (shape-preserving cubic; the last value where a signal is held; slerp for quaternions) on a
uniform grid at least as fine as the stream, an integer multiple f of the new rate; h is a symmetric (zero-phase)
low-pass, flat to 0.4 rate and 60 dB down from rate / 2 on. It is left out where the stream is no faster than the new
clock: there is nothing to alias. (A tone above a quarter of a stream's own rate meets the cubic with up to 5 % error,
and that much of it may alias.) Samples that already lie on the new clock are taken as they are, to the last bit.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.log.runs import period_of
from quadexp.physics.rotation import continuous
from quadexp.physics.state import norms
from quadexp.plugins.logs.signal import GAP_PERIODS, Stream, as_stream, stretches

STOPBAND = 60.0  # dB
PASSBAND = 0.4  # of the new rate
ON_CLOCK = 1e-4  # of a period: how far a sample may lie from the new clock and be taken as it is
SAME_RATE = 1.02  # a stream faster than the new clock by less than this is not filtered


class Resampled(NamedTuple):
    """t: (n,) s, uniform within a segment. values: (n, m) a stream. segment: (n,), a gap starts a new number."""

    t: np.ndarray
    values: dict[str, np.ndarray]
    segment: np.ndarray


def resample(
    streams: Mapping[str, Stream | tuple[np.ndarray, np.ndarray]],
    rate: float,
    *,
    quaternions: Collection[str] = ("q",),
    held: Collection[str] = (),
    gaps: Mapping[str, float] | None = None,
    least: float = 0.1,
) -> Resampled:
    """Bring streams to one uniform clock of `rate` (Hz) over the times that all of them cover.

    quaternions: streams of unit quaternions, (k, 4), any order of components: interpolated on the sphere with signs
    made continuous. held: streams whose value stays until the next one comes (commands, states).
    A step longer than GAP_PERIODS of a stream's own periods is a gap; gaps: that limit in seconds, by stream,
    where it is known better. least: shortest segment kept (s).
    Raises DataError where a stream is unusable or where they have no time in common.
    """
    clean = {name: as_stream(stream, name) for name, stream in streams.items()}
    limit = {name: GAP_PERIODS * max(period_of(s.t), 1 / rate) for name, s in clean.items()} | dict(gaps or {})
    latest = max(clean, key=lambda name: clean[name].t[0])
    earliest = min(clean, key=lambda name: clean[name].t[-1])
    start = clean[latest].t[0]
    end = clean[earliest].t[-1]
    slack = ON_CLOCK / rate
    for name in [name for name in held if name in clean]:
        # On its clock where that is as fast as the new one: else its values are up to a period older than they say.
        clock = clean[name].t
        later = clock[clock >= start - slack]
        if len(later) and abs(period_of(clock) * rate - 1) < SAME_RATE - 1:
            start = max(start, later[0])
            break
    count = int(np.floor((end - start) * rate + 1e-3)) + 1
    if count < 2:
        raise DataError(f"{latest} starts at {start:.3f} s, {earliest} ends at {end:.3f} s: no time in common")
    t = start + np.arange(count) / rate
    values = {}
    for name, stream in clean.items():
        way = Way(rate, name in quaternions, name in held)
        values[name] = _on_clock(stream, t, limit[name], way)
    kept = np.logical_and.reduce([np.isfinite(x[:, 0]) for x in values.values()])
    segment = np.cumsum(np.diff(kept, prepend=False) & kept)
    long = np.bincount(segment[kept], minlength=1) >= max(2, least * rate)
    kept &= long[segment]
    if not kept.any():
        raise DataError(f"the streams {', '.join(clean)} have no {least:g} s in common without a gap")
    _, number = np.unique(segment[kept], return_inverse=True)
    return Resampled(t[kept], {name: x[kept] for name, x in values.items()}, number.astype(np.int32))


class Way(NamedTuple):
    """rate: of the new clock (Hz). sphere: whether the values are quaternions. held: whether they stay until the next
    one comes."""

    rate: float
    sphere: bool
    held: bool


def _on_clock(stream: Stream, t: np.ndarray, gap: float, way: Way) -> np.ndarray:
    """One stream at the times t; NaN in its gaps, which are longer than `gap` (s)."""
    slack = ON_CLOCK / way.rate
    values = continuous(stream.values) if way.sphere else stream.values
    out = np.full((len(t), values.shape[1]), np.nan)
    for piece in stretches(stream.t, gap):
        clock = stream.t[piece]
        inside = slice(*np.searchsorted(t, [clock[0] - slack, clock[-1] + slack]))
        if len(t[inside]):
            out[inside] = _stretch(clock, values[piece], t[inside], way)
    return out


def _stretch(times: np.ndarray, data: np.ndarray, at: np.ndarray, way: Way) -> np.ndarray:
    """Values, (k, d), at the times `at`, (k,), of one piece without gaps: taken over, low-passed or interpolated."""
    from scipy.signal import resample_poly

    slack = ON_CLOCK / way.rate
    faster = 1 / (period_of(times) * way.rate)
    near = _latest(times, at + slack)
    if np.abs(times[near] - at).max() <= slack and faster < SAME_RATE:
        return data[near]
    factor = int(np.ceil(faster / SAME_RATE))
    if factor < 2:
        return interpolate(times, data, at, sphere=way.sphere, held=way.held)
    grid = at[0] + np.arange((len(at) - 1) * factor + 1) / (way.rate * factor)
    fine = interpolate(times, data, grid, sphere=way.sphere, held=way.held)
    # the ends are continued by point reflection, which keeps lines
    smooth = resample_poly(fine, 1, factor, window=low_pass(factor), padtype="antireflect")
    return smooth / norms(smooth)[:, None] if way.sphere else smooth


@lru_cache(maxsize=64)
def low_pass(factor: int) -> np.ndarray:
    """Taps (odd number, symmetric, gain 1) of the filter before decimation by `factor`."""
    from scipy.signal import firwin, kaiserord

    width = (0.5 - PASSBAND) / factor * 2  # of the fine grid's Nyquist frequency
    taps, beta = kaiserord(STOPBAND, width)
    return firwin(taps | 1, (0.5 + PASSBAND) / factor, window=("kaiser", beta))


def _latest(t: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The last row of t that is not later than each time, (k,); the first one where all are."""
    return np.maximum(np.searchsorted(t, at, side="right") - 1, 0)


def interpolate(
    t: np.ndarray, values: np.ndarray, at: np.ndarray, *, sphere: bool = False, held: bool = False
) -> np.ndarray:
    """values (k, m) given at t, at the times `at`: shape-preserving cubic (Fritsch and Butland 1984), slerp (sphere) or
    the last value (held)."""
    from scipy.interpolate import PchipInterpolator
    from scipy.spatial.transform import Rotation, Slerp

    at = np.clip(at, t[0], t[-1])
    if held:
        return values[_latest(t, at + 1e-9)]
    if not sphere:
        return PchipInterpolator(t, values)(at)
    whole = norms(values) > 0  # NaN is not; what is left out here is refused elsewhere
    if whole.sum() < 2:
        return np.full((len(at), values.shape[1]), np.nan)
    t = t[whole]
    along = Slerp(t, Rotation.from_quat(values[whole], scalar_first=True))
    return along(np.clip(at, t[0], t[-1])).as_quat(scalar_first=True)
