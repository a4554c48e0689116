"""Factors of single axes: which column of a sensor is in another unit, or reads too much.

Of one axis of a relation, x_k what the motion says over a window and y_k what the sensor read, both less their means:

    low  = sum x y / sum x^2            too small where x is noisy
    high = sum y^2 / sum x y            too large where y is noisy

The true gain lies between both where their noises are independent (Frisch 1934), so that a factor is seen where both
lie on one side of 1. Its estimate has the other half of each window as instrument (Reiersol 1941), whose noise is
another one: with a and b the halves,

    size = sum y_a y_b / sum (x_a y_b + x_b y_a) / 2

Standard errors are those of a jackknife over stretches of the flight.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from quadexp.plugins.check.candidates import COLUMNS, DIMENSIONS, KEYS, Candidate
from quadexp.plugins.check.sides import Side, force_of_halves, in_world, jackknife, stretches_of, whole
from quadexp.plugins.logs.signal.windows import Windows, pairs
from quadexp.plugins.logs.units import UNITS

KEPT = 0.9  # share of the windows: knocks are left out
REFITS = 3  # times that rows near the line are chosen, about the line of the time before
SURE = 5.0  # standard errors
IN_UNIT = 3.0  # standard errors, within which a factor may be that of a unit
NEAR_UNIT = 0.04  # of the logarithm, to which it may be besides
WIDEST = 2.5  # high over low, up to which a unit is given
LEAST_CORRELATION = 0.3  # below, motion explains a tenth of the variance and its slope says nothing
ALIKE = 0.03  # within which an axis has the factor of all
BLOCKS = 0.08  # of a gyro or accelerometer: less is a calibration
COST = 1.2  # log units: how much a candidate claims; see Candidate.cost
COST_AXIS = 0.2  # log units, of each axis more
COST_STREAMS = {"w": 0.0, "f": 0.0, "v": 0.0, "p": 0.1}  # log units besides; position and velocity together 0.2
LEAST = {"velocity": 0.015, "rate": 0.03, "force": 0.03}  # deviation of a gain from 1
LEAST_UNIT = 0.5  # of position and velocity against the force, which an attitude that leans changes too
LEAST_OF_ALL = 0.015  # of the three axes of a gyro together
# Of a force beside the thrust, an attitude that leans with the motion makes as much (share, m/s^2 root mean square).
LATERAL = 0.1
LATERAL_EFFECT = 0.1  # m/s^2
LATERAL_SAID = 0.065  # m/s^2: sound flights of NanoBench have up to 0.060. A warning, which names both
LEANS = "or the attitude leans with the motion, which looks the same"


class Gains(NamedTuple):
    """Of one relation: of x, y, z and of all together, (4,). signal: of the motion, root mean square less its mean.
    correlation: of both sides. size: the estimate between low and high."""

    low: np.ndarray
    high: np.ndarray
    size: np.ndarray
    low_error: np.ndarray
    high_error: np.ndarray
    signal: np.ndarray
    correlation: np.ndarray

    def apart(self, least: np.ndarray | float) -> np.ndarray:
        """Whose gain is surely further from 1 than `least`, (4,). None where an axis is reversed: that is another
        fault, which is named first."""
        if self.correlation.min() < -LEAST_CORRELATION:
            return np.zeros(4, bool)
        above = self.low - SURE * self.low_error > 1 + least
        below = (self.high + SURE * self.high_error < 1 - least) & (self.high > 0)
        return (self.correlation > LEAST_CORRELATION) & (above | below)

    @property
    def inverse(self) -> Gains:
        """Of the other side."""
        low_error = self.high_error / self.high**2
        high_error = self.low_error / self.low**2
        return Gains(1 / self.high, 1 / self.low, 1 / self.size, low_error, high_error, self.signal, self.correlation)


def gains(x: np.ndarray, y: np.ndarray, windows: int, halves: Side | None = None) -> Gains:
    """Of what the motion says and a sensor read, (n, 3), n a multiple of the number of windows.

    halves: the same of the first halves of the windows, then of the second; None where x and y are that, or where only
    whole windows are known.
    """
    kept = _near(y - x)
    for _ in range(REFITS):  # about the line that was found, else large motions are left out
        low, high, correlation = _regressions(x[kept], y[kept])
        middle = np.sqrt(np.maximum(low * high, 0.0))
        line = np.where(correlation > LEAST_CORRELATION, middle, 1.0)[:3]
        kept = _near(y - line * x)
    both = kept.reshape(-1, windows).all(axis=0)
    x_halves, y_halves = (side.reshape(-1, windows, 3)[:, both] for side in halves or (x, y))
    stretch = stretches_of(len(x), windows)[kept]
    x = x[kept]
    y = y[kept]
    low, high, correlation = _regressions(x, y)
    size = np.sqrt(np.maximum(low * high, 0.0))
    if len(x_halves) == 2:
        size = _by_instrument(x_halves, y_halves)
    size = np.clip(size, np.minimum(low, high), np.maximum(low, high))
    low_error, high_error, _ = jackknife(lambda rows: np.array(_regressions(x[rows], y[rows])), stretch)
    signal = np.sqrt(_with_all(np.var(x, axis=0)))
    return Gains(low, high, size, low_error, high_error, signal, correlation)


def _with_all(sums: np.ndarray) -> np.ndarray:
    """Of x, y, z, and of all together, (4,)."""
    return np.append(sums, sums.sum())


def _by_instrument(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Gain (4,) of the halves of windows, (2, n, 3), each with the other one as its instrument."""
    x = x - x.mean(axis=1, keepdims=True)
    y = y - y.mean(axis=1, keepdims=True)
    yy = _with_all(np.sum(y[0] * y[1], axis=0))
    xy = _with_all(np.sum(x[0] * y[1] + x[1] * y[0], axis=0)) / 2
    return np.divide(yy, xy, out=np.ones(4), where=xy > 0)


def _near(gap: np.ndarray) -> np.ndarray:
    """Mask (n,) of the smaller KEPT of gaps (n, 3), each axis less its median and over its scatter."""
    gap = gap - np.median(gap, axis=0)
    scale = np.maximum(np.median(np.abs(gap), axis=0), 1e-9)
    size = np.sum((gap / scale) ** 2, axis=1)
    return size <= np.quantile(size, KEPT)


def _regressions(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both gains and the correlation, (4,) each."""
    x = x - x.mean(axis=0)
    y = y - y.mean(axis=0)
    xx = _with_all(np.sum(x * x, axis=0))
    yy = _with_all(np.sum(y * y, axis=0))
    xy = _with_all(np.sum(x * y, axis=0))
    least = 1e-20 * (1.0 + xx + yy)  # an axis that does not move has the gain 1
    xx = xx + least
    yy = yy + least
    xy = xy + least
    low = xy / xx
    high = yy / np.where(np.abs(xy) > least / 2, xy, least)
    return low, high, xy / np.sqrt(xx * yy)


def axis_candidates(windows: Windows, *, small: bool = False) -> list[Candidate]:
    """Streams of which some axes have another factor than the rest, and gyros that have a small one. small: also what
    may be the attitude's doing."""
    count = len(windows.t)
    known = {pair.name: (pair.expected, pair.measured) for pair in pairs(windows)}
    candidates = []
    if "velocity" in known:
        motion, read = known["velocity"]
        gain = gains(motion, read, count)
        off = gain.apart(LEAST["velocity"])
        candidates += _candidates("v", off, gain) + _candidates("p", off, gain.inverse)
    if "rate" in known:
        candidates += _of_gyro(gains(*known["rate"], count))
    side = in_world(windows)
    if side is not None:
        gain = gains(side.read, side.expected, count)
        streams = "".join(name for name in "pv" if name in windows.streams)
        for candidate in _candidates(streams, gain.apart(LEAST_UNIT), gain):
            if candidate.fault == "units":
                candidates.append(candidate)
    halves = force_of_halves(windows)
    if halves is not None:
        candidates += _of_accelerometer(gains(*whole(halves), count, halves), small)
    return candidates


def _of_gyro(gain: Gains) -> list[Candidate]:
    size = float(gain.size[3])
    alike = (gain.low < size + ALIKE) & (gain.high > size - ALIKE)
    if not (gain.apart(LEAST_OF_ALL)[3] and alike.all() and abs(size - 1) < 0.5):
        return _candidates("w", gain.apart(LEAST["rate"]), gain)
    error = 100 * float(gain.high_error[3]) / size
    text = f"{size:.4g} times their true size (standard error {error:.1g} %)"
    severity = "warning" if abs(size - 1) < BLOCKS else "blocking"
    return [Candidate("scale", "w", text, {"rate": {"scale": float(f"{1 / size:.5g}")}}, COST, severity)]


def _of_accelerometer(gain: Gains, small: bool) -> list[Candidate]:
    """Beside the thrust an attitude that leans with the motion makes a factor too: a larger one is named; small: a
    smaller one that is sure besides, with both causes."""
    lateral = np.array([True, True, False, False])
    surely = np.maximum(gain.low - 1, 1 - gain.high)  # how far from 1 the gain is at least
    deviation = np.abs(gain.high - 1)
    apart = gain.apart(LEAST["force"])
    larger = gain.apart(LATERAL) & (surely * gain.signal > LATERAL_EFFECT)
    off = np.where(lateral, larger, apart)
    leans = apart & lateral & ~off
    leans &= (deviation > LATERAL) & (deviation * gain.signal > LATERAL_SAID)
    if not (small and leans.any()):
        return _candidates("f", off, gain)
    candidates = _candidates("f", off | leans, gain)
    return [replace(candidate, text=f"{candidate.text}, {LEANS}") for candidate in candidates]


def _candidates(streams: str, off: np.ndarray, gain: Gains) -> list[Candidate]:
    """off: axes with a factor, (4,), the last of which does not count. gain: by which a column is too large. streams:
    that have it, of one unit."""
    dimension = DIMENSIONS[streams[0]]
    undone = [1.0, 1.0, 1.0]
    words = []
    units = []
    small = streams in "wf"
    for axis in np.flatnonzero(off[:3]):
        size = float(gain.size[axis])
        error = float(gain.high_error[axis] / gain.high[axis])
        unit = _unit(dimension, float(gain.low[axis]), float(gain.high[axis]), error)
        factor = 1 / size
        about = f"standard error {100 * error:.1g} %"
        if unit is not None:
            factor = UNITS[dimension][unit]
            about = f"in {unit}"
        undone[axis] = float(f"{factor:.7g}")
        columns = ", ".join(COLUMNS[stream].replace("*", "xyz"[axis]) for stream in streams)
        words.append(f"{columns} is {size:.4g} times its true size ({about})")
        units.append(unit)
        small &= abs(size - 1) < BLOCKS
    if not words:
        return []
    lines: dict[str, object] = {"scale": undone}
    if len(units) == 3 and len(set(units)) == 1 and all(units) and len(streams) == 1:
        lines = {"unit": units[0]}
    fault = "units" if all(units) else "scale"
    severity = "warning" if small else "blocking"
    cost = COST + COST_AXIS * len(words) + COST_STREAMS.get(streams, 0.2)
    correction = {KEYS[stream]: lines for stream in streams}
    axes = tuple(np.flatnonzero(off[:3]).tolist())
    return [Candidate(fault, streams, ", ".join(words), correction, cost, severity, axes=axes)]


def _unit(dimension: str, low: float, high: float, error: float) -> str | None:
    """The unit, other than SI, that makes a column so many times too large."""
    if not 0 < high < WIDEST * low:
        return None
    least = low * (1 - IN_UNIT * error) * np.exp(-NEAR_UNIT)
    most = high * (1 + IN_UNIT * error) * np.exp(NEAR_UNIT)
    fitting = {}
    for unit, factor in UNITS[dimension].items():
        if factor != 1.0 and least < 1 / factor < most:
            fitting[unit] = abs(np.log(high * factor))
    return min(fitting, key=fitting.__getitem__, default=None)
