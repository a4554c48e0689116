"""Factors of single axes: which column of a sensor is in another unit, or reads too much.

Of one axis of a relation, x_k what the motion says over a window and y_k what the sensor read, both less their means:

    low  = sum x y / sum x^2            too small where x is noisy
    high = sum y^2 / sum x y            too large where y is noisy

The true gain lies between both where their noises are independent (Frisch 1934), so that a factor is seen where both
lie on one side of 1. Its estimate has the other half of each window as instrument (Reiersol 1941), whose noise is
another one: with a and b the halves,

    size = sum y_a y_b / sum (x_a y_b + x_b y_a) / 2

Standard errors are those of a jackknife over stretches of the flight. Of a force, x and y are means over a window in
the body as it turns, which a difference of velocities has the least noise in:

    x = sum_k R_k^T (v_k+1 - v_k + g e_z dt) / T,     y = mean f
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from quadexp.physics.vehicle import GRAVITY
from quadexp.plugins.check.candidates import COLUMNS, KEYS, Candidate, stretches_of, world_acceleration
from quadexp.plugins.logs.signal.windows import UP, Windows, means, pairs, weighted
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
COST, COST_AXIS = 1.2, 0.2  # log units: how much a candidate claims, and each axis more; see Candidate.cost
DIMENSIONS = {"p": "length", "v": "velocity", "w": "rate", "f": "acceleration"}
LEAST = {"velocity": 0.015, "rate": 0.03, "force": 0.03}  # deviation of a gain from 1
LEAST_UNIT = 0.5  # of position and velocity against the force, which an attitude that leans changes too
LEAST_OF_ALL = 0.015  # of the three axes of a gyro together
# Of a force beside the thrust, an attitude that leans with the motion makes as much (share, m/s^2 root mean square).
LATERAL, LATERAL_EFFECT = 0.1, 0.1
LATERAL_SAID = 0.065  # m/s^2: sound flights of NanoBench have up to 0.060. A warning, which names both
Sides = tuple[np.ndarray, np.ndarray]  # what the motion says, what the sensor read
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

    def apart(self, least: np.ndarray) -> np.ndarray:
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
        low_error, high_error = self.high_error / self.high**2, self.low_error / self.low**2
        parts = 1 / self.high, 1 / self.low, 1 / self.size, low_error, high_error
        return Gains(*parts, self.signal, self.correlation)

    @property
    def nearest(self) -> np.ndarray:
        """How far from 1 the gain is at least, (4,)."""
        return np.maximum(np.maximum(self.low - 1, 1 - self.high), 0.0)


def gains(x: np.ndarray, y: np.ndarray, windows: int, halves: Sides | None = None) -> Gains:
    """Of what the motion says and a sensor read, (n, 3), n a multiple of the number of windows.

    halves: the same of the first halves of the windows, then of the second; None where x and y are that, or where only
    whole windows are known.
    """
    kept = _near(y - x)
    for _ in range(REFITS):  # about the line that was found, else large motions are left out
        low, high, correlation = _regressions(x[kept], y[kept])
        middle = np.sqrt(np.maximum(low * high, 1e-300))[:3]
        kept = _near(y - np.where(correlation[:3] > LEAST_CORRELATION, middle, 1.0) * x)
    both = kept.reshape(-1, windows).all(axis=0)
    of_halves = [side.reshape(-1, windows, 3)[:, both] for side in halves or (x, y)]
    stretch = stretches_of(len(x), windows)[kept]
    x, y = x[kept], y[kept]
    low, high, correlation = _regressions(x, y)
    size = _by_instrument(*of_halves) if len(of_halves[0]) == 2 else np.sqrt(np.maximum(low * high, 0.0))
    size = np.clip(size, np.minimum(low, high), np.maximum(low, high))
    rest = [_regressions(x[stretch != k], y[stretch != k]) for k in np.unique(stretch)]
    low_error, high_error = (_jackknife([each[i] for each in rest]) for i in (0, 1))
    signal = x.std(axis=0)
    signal = np.append(signal, np.linalg.norm(signal))
    return Gains(low, high, size, low_error, high_error, signal, correlation)


def _by_instrument(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Gain (4,) of the halves of windows, (2, n, 3), each with the other one as its instrument."""
    x = x - x.mean(axis=1, keepdims=True)
    y = y - y.mean(axis=1, keepdims=True)
    yy = np.sum(y[0] * y[1], axis=0)
    xy = np.sum(x[0] * y[1] + x[1] * y[0], axis=0) / 2
    yy, xy = np.append(yy, yy.sum()), np.append(xy, xy.sum())
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
    xx, yy, xy = (np.sum(product, axis=0) for product in (x * x, y * y, x * y))
    xx, yy, xy = (np.append(sums, sums.sum()) for sums in (xx, yy, xy))
    least = 1e-20 * (1.0 + xx + yy)  # an axis that does not move has the gain 1
    xx, yy, xy = xx + least, yy + least, xy + least
    return xy / xx, yy / np.where(np.abs(xy) > least / 2, xy, least), xy / np.sqrt(xx * yy)


def _jackknife(estimates: list[np.ndarray]) -> np.ndarray:
    count = len(estimates)
    if count < 3:
        return np.full(4, np.inf)
    return np.sqrt((count - 1) * np.var(estimates, axis=0))


def axis_candidates(windows: Windows, *, small: bool = False) -> list[Candidate]:
    """Streams of which some axes have another factor than the rest, and gyros that have a small one. small: also what
    may be the attitude's doing."""
    known = {pair.name: pair for pair in pairs(windows)}
    candidates: list[Candidate] = []
    if (velocity := known.get("velocity")) is not None:
        gain = gains(velocity.expected, velocity.measured, len(windows.t))
        off = gain.apart(np.full(4, LEAST["velocity"]))[:3]
        candidates += _candidates("v", off, gain)
        candidates += _candidates("p", off, gain.inverse, 0.1)
    if (rate := known.get("rate")) is not None:
        gain = gains(rate.expected, rate.measured, len(windows.t))
        off = gain.apart(np.append(np.full(3, LEAST["rate"]), LEAST_OF_ALL))
        whole = float(gain.size[3])
        alike = (gain.low[:3] < whole + ALIKE) & (gain.high[:3] > whole - ALIKE)
        if off[3] and alike.all() and abs(whole - 1) < 0.5:
            candidates.append(_of_all("w", whole, float(gain.high_error[3])))
        else:
            candidates += _candidates("w", off[:3], gain)
    if (sides := world_acceleration(windows)) is not None:
        motion, force = sides
        gain = gains(force, motion, len(windows.t))
        streams = "".join(name for name in "pv" if name in windows.streams)
        off = gain.apart(np.full(4, LEAST_UNIT))[:3]
        candidates += [each for each in _candidates(streams, off, gain, 0.2) if each.fault == "units"]
    if (halves := body_force_of_halves(windows)) is not None:
        gain = gains(*of_windows(halves), len(windows.t), halves)
        least = np.array([LATERAL, LATERAL, LEAST["force"], 0.0])
        off = gain.apart(least)[:3]
        off[:2] &= (gain.nearest * gain.signal)[:2] > LATERAL_EFFECT
        leans = _may_lean(gain) & ~off if small else np.zeros(3, bool)
        for candidate in _candidates("f", off | leans, gain):
            candidates.append(replace(candidate, text=f"{candidate.text}, {LEANS}") if leans.any() else candidate)
    return candidates


def _may_lean(gain: Gains) -> np.ndarray:
    """Axes beside the thrust, (3,), whose factor is sure, and so small that an attitude may have made it."""
    size = np.abs(gain.high - 1)[:3]  # of which LATERAL_SAID is
    sure = gain.apart(np.full(4, LEAST["force"]))[:3]
    return sure & (size > LATERAL) & (size * gain.signal[:3] > LATERAL_SAID) & np.array([True, True, False])


def body_force(windows: Windows) -> Sides | None:
    """What the motion says and what the accelerometer read, means over windows in the body, (n, 3); None where a stream
    is missing."""
    halves = body_force_of_halves(windows)
    return None if halves is None else of_windows(halves)


def body_force_of_halves(windows: Windows) -> Sides | None:
    """The same of the first halves of the windows, then of the second, (2n, 3)."""
    t, streams = windows.t, windows.streams
    if not set("qvf") <= streams.keys():
        return None
    step = np.diff(t, axis=1)[..., None]
    turn = windows.rotation
    change = np.diff(streams["v"], axis=1) / step + GRAVITY * UP
    middle = (turn[:, 1:] + turn[:, :-1]) / 2
    return weighted(t, np.einsum("nlij,nli->nlj", middle, change)), means(t, streams["f"])


def of_windows(halves: Sides) -> Sides:
    """Means over whole windows, (n, 3), of those over their halves, (2n, 3), which are as long."""
    x, y = (side.reshape(2, -1, 3).mean(axis=0) for side in halves)
    return x, y


def _of_all(stream: str, size: float, error: float) -> Candidate:
    text = f"{size:.4g} times their true size (standard error {100 * error / size:.1g} %)"
    lines = {KEYS[stream]: {"scale": float(f"{1 / size:.5g}")}}
    severity = "warning" if abs(size - 1) < BLOCKS else "blocking"
    return Candidate("scale", stream, text, lines, COST, severity)


def _candidates(streams: str, off: np.ndarray, gain: Gains, more: float = 0.0) -> list[Candidate]:
    """off: axes with a factor, (3,). gain: by which a column is too large. streams: that have it, of one unit."""
    if not off.any():
        return []
    undone = [1.0, 1.0, 1.0]
    words, sizes, units = [], [], list[str | None]()
    for axis in np.flatnonzero(off):
        size = float(gain.size[axis])
        columns = ", ".join(COLUMNS[stream].replace("*", "xyz"[axis]) for stream in streams)
        error = float(gain.high_error[axis] / gain.high[axis])
        unit = _unit(streams[0], float(gain.low[axis]), float(gain.high[axis]), error)
        undone[axis] = float(f"{UNITS[DIMENSIONS[streams[0]]][unit] if unit else 1 / size:.7g}")
        units.append(unit)
        sizes.append(size)
        about = f" (in {unit})" if unit else f" (standard error {100 * error:.1g} %)"
        words.append(f"{columns} is {size:.4g} times its true size{about}")
    small = bool(np.abs(np.array(sizes) - 1).max() < BLOCKS) and streams in "wf"
    fault = "units" if all(units) else "scale"
    lines: dict[str, object] = {"scale": undone}
    if all(units) and len(units) == 3 and len(set(units)) == 1 and len(streams) == 1:
        lines = {"unit": units[0]}
    cost = COST + COST_AXIS * len(words) + more
    severity = "warning" if small else "blocking"
    return [Candidate(fault, streams, ", ".join(words), {KEYS[stream]: lines for stream in streams}, cost, severity)]


def _unit(stream: str, low: float, high: float, error: float) -> str | None:
    """The unit, other than SI, that makes a column so many times too large."""
    if not 0 < high < WIDEST * low:
        return None
    least = low * (1 - IN_UNIT * error) * np.exp(-NEAR_UNIT)
    most = high * (1 + IN_UNIT * error) * np.exp(NEAR_UNIT)
    fitting = {}
    for unit, factor in UNITS[DIMENSIONS[stream]].items():
        if factor != 1.0 and least < 1 / factor < most:
            fitting[unit] = abs(np.log(high * factor))
    return min(fitting, key=fitting.__getitem__) if fitting else None
