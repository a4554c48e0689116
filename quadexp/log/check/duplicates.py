"""One flight under two names: the same bytes, the same samples, or the same motion cropped, shifted or resampled.

Two flights of one trajectory look alike; the noise of their sensors does not. So what is compared is what changes
quickest, the body rates and specific force (velocity and attitude where there is neither), on one 20 Hz clock: the lag
of the highest correlation of their differences, then the residual after alignment over the common stretch.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.log.finding import Finding
from quadexp.log.hypotheses.windows import STREAMS
from quadexp.log.schema import Flight
from quadexp.log.signal import Stream, increasing, resample

RATE = 20.0  # Hz: what two ways of resampling leave alike, noise of the sensors included
LEAST = 2.0  # s in common
LEAST_SHARE = 0.3  # of the shorter one
ALIKE = 0.1  # residual over signal: resampling leaves up to 0.05, another flight of the same path 0.3 and more
COARSE = 0.7  # correlation that is worth a closer look


class _Trace(NamedTuple):
    t: np.ndarray
    values: np.ndarray
    change: np.ndarray
    streams: str
    digest: str
    source: str
    made: str


def check_duplicates(flights: Mapping[str, Flight]) -> dict[str, list[Finding]]:
    """Findings by flight; of two that are alike the later one in the order given is the duplicate."""
    found: dict[str, list[Finding]] = {}
    seen: list[tuple[str, _Trace]] = []
    for name, flight in flights.items():
        trace = _trace(flight)
        if trace is None:
            continue
        for other, earlier in seen:
            alike = _compare(trace, earlier)
            if alike is not None:
                measured, start, stop = alike
                where = f"all samples, {start:.2f}..{stop:.2f} s"
                advice = f"leave it out, or keep it on the same side of a split as {other}"
                text = f"{measured} {other}"
                found.setdefault(name, []).append(
                    Finding("duplicate", "blocking", where, text, f"residual over signal {ALIKE:g}", advice)
                )
                break
        seen.append((name, trace))
    return found


def _trace(flight: Flight) -> _Trace | None:
    t = np.asarray(flight.t, float)
    usable = increasing(t)
    names = [name for name in "wfvp" if all(column in flight.columns for column in STREAMS[name])]
    values = {name: flight.stack(STREAMS[name]).astype(float) for name in names}
    digest = hashlib.sha256()
    for name in sorted(names):
        digest.update(np.ascontiguousarray(values[name]).tobytes())
    source = str((flight.metadata.get("source") or {}).get("sha256", ""))
    made = "" if flight.metadata.get("recorded") else str(flight.metadata.get("provenance", {}).get("config_hash", ""))
    chosen = [name for name in names if name in ("wf" if {"w", "f"} & set(names) else "vp")]
    try:
        common = resample({name: Stream(t[usable], values[name][usable]) for name in chosen}, RATE, quaternions=())
    except DataError:
        return None
    longest = np.argmax(np.bincount(common.segment))
    samples = common.segment == longest
    data = np.concatenate([_unit(common.values[name][samples]) for name in chosen], axis=1)
    if len(data) < LEAST * RATE:
        return None
    change = np.diff(data, axis=0)
    return _Trace(common.t[samples], data, change, "".join(chosen), digest.hexdigest(), source, made)


def _unit(x: np.ndarray) -> np.ndarray:
    """Normalised to mean zero and variance one over all axes, so that units do not matter."""
    x = x - x.mean(axis=0)
    return x / max(float(np.sqrt(np.mean(x * x))), 1e-9)


def _compare(a: _Trace, b: _Trace) -> tuple[str, float, float] | None:
    if a.source and a.source == b.source:
        return "made from the same file, to the last byte, as", float(a.t[0]), float(a.t[-1])
    if a.digest == b.digest:
        return "the same numbers to the last digit as", float(a.t[0]), float(a.t[-1])
    if a.streams != b.streams or (a.made and b.made and a.made != b.made):
        return None
    lag, height = _best_lag(a.change, b.change)
    if height < COARSE:
        return None
    shift, residual, start, stop = _align(a, b, lag)
    if residual > ALIKE:
        return None
    text = f"the same motion, {shift:+.3f} s apart on their own clocks (residual over signal {residual:.3f}), as"
    return text, float(a.t[start]), float(a.t[stop - 1])


def _best_lag(x: np.ndarray, y: np.ndarray) -> tuple[int, float]:
    """Samples by which y lies behind x at the highest correlation over a long enough overlap, and that correlation."""
    from scipy.signal import correlate

    dot = sum(correlate(y[:, j], x[:, j], mode="full", method="fft") for j in range(x.shape[1]))
    lags = np.arange(-(len(x) - 1), len(y))
    start, stop = np.maximum(0, -lags), np.minimum(len(x), len(y) - lags)  # samples of x that have a partner
    energy_x, energy_y = (np.concatenate([[0.0], np.cumsum(np.sum(z * z, axis=1))]) for z in (x, y))
    both = (energy_x[stop] - energy_x[start]) * (energy_y[stop + lags] - energy_y[start + lags])
    enough = stop - start >= max(LEAST * RATE - 2, LEAST_SHARE * min(len(x), len(y)))
    value = np.where(enough & (both > 0), dot / np.sqrt(np.maximum(both, 1e-12)), -1.0)
    best = int(np.argmax(value))
    return int(lags[best]), float(value[best])


def _align(a: _Trace, b: _Trace, lag: int) -> tuple[float, float, int, int]:
    """Shift of b's clock against a's (s), residual over signal, and the samples of a in common."""
    from scipy.interpolate import CubicSpline

    start, stop = max(0, -lag) + 2, min(len(a.values), len(b.values) - lag) - 2
    spline = CubicSpline(np.arange(len(b.values)), b.values)
    samples = np.arange(start, stop)
    best = (np.inf, 0.0)
    for fraction in np.linspace(-1, 1, 41):
        moved = spline(samples + lag + fraction)
        parts = [_left(a.values[start:stop, k : k + 3], moved[:, k : k + 3]) for k in range(0, moved.shape[1], 3)]
        best = min(best, (float(np.sqrt(np.mean(parts))), float(fraction)))
    residual, fraction = best
    shift = float(b.t[0] + (start + lag + fraction) / RATE - a.t[start])
    return shift, residual, start, stop


def _left(x: np.ndarray, y: np.ndarray) -> float:
    """Share of the variance of x that y, scaled and shifted, does not explain."""
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    scale = np.sum(x * y) / max(np.sum(y * y), 1e-12)
    return float(np.sum((x - scale * y) ** 2) / max(np.sum(x * x), 1e-12))
