"""One flight under two names: the same bytes, the same samples, or the same motion cropped, shifted or resampled.

Two flights of one trajectory look alike; the noise of their sensors does not. So what is compared is what changes
quickest, the body rates and specific force (velocity and position where there is neither), on one 20 Hz clock: the lag
of the highest correlation of their differences, then the residual after alignment over the common stretch.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.log.check.finding import Finding
from quadexp.log.schema import Flight
from quadexp.log.signal import Stream, increasing, resample
from quadexp.log.signal.windows import STREAMS

RATE = 20.0  # Hz: what two ways of resampling leave alike, noise of the sensors included
LEAST = 2.0  # s in common
LEAST_SHARE = 0.3  # of the shorter one
ALIKE = 0.1  # residual over signal: resampling leaves up to 0.05, another flight of the same path 0.3 and more
COARSE = 0.7  # correlation that is worth a closer look


class _Trace(NamedTuple):
    """values: (k, 3 streams) at t (k,), on one clock, of mean zero and size one. config: what a simulation was of."""

    t: np.ndarray
    values: np.ndarray
    streams: str
    digest: str
    source: str
    config: str


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
                text, where = f"{alike} {other}", f"all samples, {trace.t[0]:.2f}..{trace.t[-1]:.2f} s"
                advice = f"leave it out, or keep it on the same side of a split as {other}"
                allowed = f"residual over signal {ALIKE:g}"
                found[name] = [Finding("duplicate", "blocking", where, text, allowed, advice)]
                break
        seen.append((name, trace))
    return found


def _trace(flight: Flight) -> _Trace | None:
    usable = increasing(flight.t)
    values = {n: flight.stack(STREAMS[n]).astype(float) for n in "wfvp" if set(STREAMS[n]) <= set(flight.columns)}
    chosen = "".join(name for name in ("wf" if {"w", "f"} & set(values) else "vp") if name in values)
    try:
        streams = {name: Stream(flight.t[usable], values[name][usable]) for name in chosen}
        common = resample(streams, RATE, quaternions=())
    except DataError:
        return None
    samples = common.segment == np.argmax(np.bincount(common.segment))
    centred = [common.values[name][samples] - common.values[name][samples].mean(axis=0) for name in chosen]
    if samples.sum() < LEAST * RATE:
        return None
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(values[name]).tobytes() for name in sorted(values)))
    record = flight.metadata
    source = str((record.get("source") or {}).get("sha256", ""))
    config = "" if record.get("recorded") else str(record.get("provenance", {}).get("config_hash", ""))
    data = np.concatenate([x / max(float(np.sqrt(np.mean(x * x))), 1e-9) for x in centred], axis=1)
    return _Trace(common.t[samples], data, chosen, digest.hexdigest(), source, config)


def _compare(a: _Trace, b: _Trace) -> str | None:
    """How two flights are the same, or None."""
    if a.source and a.source == b.source:
        return "made from the same file, to the last byte, as"
    if a.digest == b.digest:
        return "the same numbers to the last digit as"
    if a.streams != b.streams or (a.config and b.config and a.config != b.config):
        return None
    lag, height = _best_lag(np.diff(a.values, axis=0), np.diff(b.values, axis=0))
    if height < COARSE:
        return None
    shift, residual = _align(a, b, lag)
    if residual > ALIKE:
        return None
    return f"the same motion, {shift:+.3f} s apart on their own clocks (residual over signal {residual:.3f}), as"


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


def _align(a: _Trace, b: _Trace, lag: int) -> tuple[float, float]:
    """Shift of b's clock against a's (s), and residual over signal."""
    from scipy.interpolate import CubicSpline

    start, stop = max(0, -lag) + 2, min(len(a.values), len(b.values) - lag) - 2
    spline = CubicSpline(np.arange(len(b.values)), b.values)

    def residual(fraction: float) -> float:
        moved = spline(np.arange(start, stop) + lag + fraction)
        parts = [_left(a.values[start:stop, k : k + 3], moved[:, k : k + 3]) for k in range(0, moved.shape[1], 3)]
        return float(np.sqrt(np.mean(parts)))

    best = min(np.linspace(-1, 1, 41), key=residual)
    return float(b.t[0] + (start + lag + best) / RATE - a.t[start]), residual(best)


def _left(x: np.ndarray, y: np.ndarray) -> float:
    """Share of the variance of x that y, scaled and shifted, does not explain."""
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    scale = np.sum(x * y) / max(np.sum(y * y), 1e-12)
    return float(np.sum((x - scale * y) ** 2) / max(np.sum(x * x), 1e-12))
