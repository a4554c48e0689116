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
    start = max(s.t[0] for s in clean.values())
    end = min(s.t[-1] for s in clean.values())
    slack = ON_CLOCK / rate
    for name in held:
        if name not in clean:
            continue
        # On its clock where that is as fast as the new one: else its values are up to a period older than they say.
        at = int(np.searchsorted(clean[name].t, start - slack))
        if at < len(clean[name].t) and abs(period_of(clean[name].t) * rate - 1) < SAME_RATE - 1:
            start = max(start, float(clean[name].t[at]))
            break
    count = int(np.floor((end - start) * rate + 1e-3)) + 1 if end >= start else 0
    if count < 2:
        latest = max(clean, key=lambda name: clean[name].t[0])
        earliest = min(clean, key=lambda name: clean[name].t[-1])
        raise DataError(f"{latest} starts at {start:.3f} s, {earliest} ends at {end:.3f} s: no time in common")
    t = start + np.arange(count) / rate
    kept = np.ones(count, bool)
    pieces = {}
    for name, stream in clean.items():
        pieces[name] = stretches(stream.t, limit[name])
        covered = np.zeros(count, bool)
        for piece in pieces[name]:
            low, high = np.searchsorted(t, [stream.t[piece.start] - slack, stream.t[piece.stop - 1] + slack])
            covered[low:high] = True
        kept &= covered
    segment = np.cumsum(np.concatenate([[True], kept[1:] & ~kept[:-1]])) - 1
    segment -= segment[np.argmax(kept)]
    short = np.bincount(segment[kept], minlength=1) < max(2, least * rate)
    kept[kept] = ~short[segment[kept]]
    if not kept.any():
        raise DataError(f"the streams {', '.join(clean)} have no {least:g} s in common without a gap")
    _, number = np.unique(segment[kept], return_inverse=True)
    values = {
        name: _on_clock(stream, pieces[name], t, rate, slack, name in quaternions, name in held)[kept]
        for name, stream in clean.items()
    }
    return Resampled(t[kept], values, number.astype(np.int32))


def _on_clock(
    stream: Stream, pieces: list[slice], t: np.ndarray, rate: float, slack: float, sphere: bool, held: bool
) -> np.ndarray:
    """One stream at the times t; NaN in its gaps."""
    values = continuous(stream.values) if sphere else stream.values
    out = np.full((len(t), values.shape[1]), np.nan)
    for piece in pieces:
        clock, data = stream.t[piece], values[piece]
        low, high = np.searchsorted(t, [clock[0] - slack, clock[-1] + slack])
        at = t[low:high]
        if not len(at):
            continue
        out[low:high] = _stretch(clock, data, at, rate, slack, sphere, held)
    return out


def _stretch(
    times: np.ndarray, data: np.ndarray, at: np.ndarray, rate: float, slack: float, sphere: bool, held: bool
) -> np.ndarray:
    """Values, (k, d), at the times `at`, (k,), of one piece without gaps: taken over, low-passed or interpolated."""
    near = np.clip(np.searchsorted(times, at + slack, side="right") - 1, 0, len(times) - 1)
    if np.abs(times[near] - at).max() <= slack and 1 / period_of(times) < SAME_RATE * rate:
        return data[near]
    factor = int(np.ceil(1 / (period_of(times) * rate) / SAME_RATE))
    if factor < 2:
        return interpolate(times, data, at, sphere=sphere, held=held)
    half = len(low_pass(factor)) // 2
    grid = at[0] + np.arange((len(at) - 1) * factor + 1) / (rate * factor)
    fine = interpolate(times, data, grid, sphere=sphere, held=held)
    smooth = np.stack([_filter(column, factor, half) for column in fine.T], axis=-1)
    return smooth / np.linalg.norm(smooth, axis=1, keepdims=True) if sphere else smooth


def _filter(x: np.ndarray, factor: int, half: int) -> np.ndarray:
    """Low-pass x and take every factor-th sample; the ends are continued by point reflection, which keeps lines."""
    from scipy.signal import upfirdn

    reach = min(half, len(x) - 1)
    padded = np.concatenate([2 * x[0] - x[reach:0:-1], x, 2 * x[-1] - x[-2 : -reach - 2 : -1]])
    lead = -2 * half % factor  # so that one in every `factor` outputs lies on a sample that is kept
    padded = np.pad(padded, (half - reach + lead, half - reach), mode="edge")
    first = (2 * half + lead) // factor
    return upfirdn(low_pass(factor), padded, down=factor)[first : first + (len(x) - 1) // factor + 1]


@lru_cache(maxsize=64)
def low_pass(factor: int) -> np.ndarray:
    """Taps (odd number, symmetric, gain 1) of the filter before decimation by `factor`."""
    from scipy.signal import firwin, kaiserord

    width = (0.5 - PASSBAND) / factor * 2  # of the fine grid's Nyquist frequency
    taps, beta = kaiserord(STOPBAND, width)
    return firwin(taps | 1, (0.5 + PASSBAND) / factor, window=("kaiser", beta))


def interpolate(
    t: np.ndarray, values: np.ndarray, at: np.ndarray, *, sphere: bool = False, held: bool = False
) -> np.ndarray:
    """values (k, m) given at t, at the times `at`: shape-preserving cubic (Fritsch and Butland 1984), slerp (sphere) or
    the last value (held)."""
    from scipy.interpolate import PchipInterpolator
    from scipy.spatial.transform import Rotation, Slerp

    at = np.clip(at, t[0], t[-1])
    if held:
        return values[np.clip(np.searchsorted(t, at + 1e-9, side="right") - 1, 0, len(t) - 1)]
    if sphere:
        whole = norms(values) > 0  # NaN is not; what is left out here is refused elsewhere
        if whole.sum() < 2:
            return np.full((len(at), values.shape[1]), np.nan)
        t, values = t[whole], values[whole]
        at = np.clip(at, t[0], t[-1])
        return Slerp(t, Rotation.from_quat(values, scalar_first=True))(at).as_quat(scalar_first=True)
    return np.stack([PchipInterpolator(t, column)(at) for column in values.T], axis=-1)
