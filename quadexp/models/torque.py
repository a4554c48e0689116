"""Identified torque of the rotors: gain, lag and offset of the geometric torque, axis by axis.

    w'_i + [J^-1 (w x J w)]_i = g_i [J^-1 G m a(t - tau_i)]_i + o_i(t)         rad/s^2

a: acceleration of each rotor's thrust by the thrust curve, G: the vehicle's arms and reaction torques. g, tau and o
account for arms, inertia, drag torques, unequal rotors and motors, which a thrust curve does not contain. The offset
varies slowly (centre of mass, battery), so gain and lag are fitted after subtracting the means of blocks of BLOCK
seconds, and a prediction tracks the offset up to its start by a low-pass with MEMORY seconds, from earlier samples
only. Both sides of the fit pass the same filter (quadexp.log.signal.derivative). Intervals: percentile bootstrap over
flights, or over the blocks where there are few flights.

An axis is used if a fit to the other flights (the other half of a single flight) predicts the mean angular acceleration
over the next HORIZON seconds better than zero, that is, than constant rates; otherwise it is rejected.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from quadexp.log.signal import derivative
from quadexp.models.base import Record, Three
from quadexp.models.regression import resampling_weights
from quadexp.models.samples import Samples
from quadexp.models.thrust_curve import ThrustCurve
from quadexp.physics.vehicle import Vehicle

AXES = ("roll", "pitch", "yaw")
LAGS = np.arange(-0.02, 0.1221, 0.004)  # s
WINDOW = 0.1  # s, of the derivative
BLOCK = 2.0  # s, of the means and of the bootstrap
MEMORY = 0.4  # s, of the tracked offset
HORIZON = 0.2  # s
DRAWS = 400
LEAST_BLOCKS, LEAST_ROWS = 4, 20
PIECE, MOST_SAMPLES = 20.0, 60_000  # s, samples: longer logs are thinned by pieces


class TorqueModel(Record, frozen=True):
    """All (3,): roll, pitch, yaw. gain: relative to the geometric torque. lag: s. offset: mean, rad/s^2.

    _low, _high: 95 % interval. share: share of the mean square angular acceleration over HORIZON that is predicted on
    held-out data; share_low: its lower limit.
    """

    gain: Three
    gain_low: Three
    gain_high: Three
    lag: Three
    lag_low: Three
    lag_high: Three
    offset: Three
    offset_low: Three
    offset_high: Three
    share: Three
    share_low: Three

    @property
    def used(self) -> np.ndarray:
        """Axes, (3,) bool, whose prediction on held-out data is better than zero."""
        return np.asarray((self.share_low > 0) & (self.gain > 0))

    def driven(self, time: np.ndarray, segment: np.ndarray, geometric: np.ndarray) -> np.ndarray:
        """Angular acceleration by the rotors without the offset, (k, 3) rad/s^2; geometric: (k, 3), at time (k,)."""
        result = np.empty_like(geometric)
        for rows in (segment == number for number in np.unique(segment)):
            result[rows] = _delayed(time[rows], geometric[rows], self.gain, self.lag)
        return result

    def tracked_offset(
        self, time: np.ndarray, segment: np.ndarray, driven: np.ndarray, rate: np.ndarray, turned: np.ndarray
    ) -> np.ndarray:
        """The offset, (k, 3) rad/s^2, at every sample from earlier ones. rate, turned: (k, 3), gyroscopic."""
        result = np.empty_like(driven)
        for rows in (segment == number for number in np.unique(segment)):
            result[rows] = _tracked(time[rows], rate[rows], driven[rows] - turned[rows], self.offset)
        return result


def _delayed(t: np.ndarray, geometric: np.ndarray, gain: np.ndarray, lag: np.ndarray) -> np.ndarray:
    return gain * np.stack([np.interp(t - lag[i], t, geometric[:, i]) for i in range(3)], axis=1)


def _tracked(t: np.ndarray, w: np.ndarray, model: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """First-order low-pass of w' - model over earlier samples, with initial value offset (3,)."""
    from scipy.signal import lfilter

    if len(t) < 2:
        return np.tile(offset, (len(t), 1))
    share = min(1.0, float(np.median(np.diff(t))) / MEMORY)
    difference = np.diff(w, axis=0) / np.diff(t)[:, None] - (model[1:] + model[:-1]) / 2
    after, _ = lfilter([share], [1, share - 1], difference, axis=0, zi=(1 - share) * offset[None])
    return np.vstack([offset, after])


class _Piece(NamedTuple):
    """A stretch without a gap: t (k,), rates, geometric and gyroscopic acceleration, (k, 3); number of its flight."""

    t: np.ndarray
    w: np.ndarray
    geometric: np.ndarray
    gyroscopic: np.ndarray
    flight: int


class _Sums(NamedTuple):
    """Per block: n, and at every lag the sums of s (geometric, filtered) and y (measured), and of products about the
    block's means (ss, sy, yy). n, flight: (blocks,). s, ss, sy: (blocks, lags, 3). y, yy: (blocks, 3)."""

    n: np.ndarray
    s: np.ndarray
    ss: np.ndarray
    sy: np.ndarray
    y: np.ndarray
    yy: np.ndarray
    flight: np.ndarray

    def fit(self, weights: np.ndarray | None = None) -> np.ndarray:
        """Gain, lag and offset, (3, d, 3), of weighted blocks, weights (d, blocks), None: of all once: least squares
        at every lag, the best lag by a parabola."""
        weights = np.ones((1, len(self.n))) if weights is None else weights
        n = (weights @ self.n)[:, None, None]
        s, ss, sy = (np.einsum("db,bla->dla", weights, x) for x in (self.s, self.ss, self.sy))
        y, yy = ((weights @ x)[:, None, :] for x in (self.y, self.yy))
        spread = np.maximum(ss, 1e-300)
        gain = sy / spread
        error = np.where(gain > 0, yy - gain**2 * spread, np.broadcast_to(yy, gain.shape))
        k = np.clip(np.argmin(error, axis=1), 1, len(LAGS) - 2)
        d, a = np.ogrid[: error.shape[0], : error.shape[2]]
        before, at, after = error[d, k - 1, a], error[d, k, a], error[d, k + 1, a]
        curve = before - 2 * at + after
        shift = np.where(curve > 0, np.clip(0.5 * (before - after) / np.where(curve > 0, curve, 1.0), -1, 1), 0.0)
        slope = gain[d, k, a]
        offset = (y[:, 0] - slope * s[d, k, a]) / n[:, 0]
        return np.stack([slope, LAGS[k] + shift * (LAGS[1] - LAGS[0]), offset])


def geometric_acceleration(rotors: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """J^-1 G m a, (k, 3) rad/s^2, of the rotors' accelerations a (k, n) (m/s^2)."""
    torque = vehicle.mass * rotors @ vehicle.allocation[1:].T
    return np.asarray(np.linalg.solve(vehicle.inertia_matrix, torque.T).T)


def gyroscopic(rate: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """J^-1 (w x J w), (k, 3) rad/s^2, of body rates (k, 3)."""
    J = vehicle.inertia_matrix
    return np.asarray(np.linalg.solve(J, np.cross(rate, rate @ J).T).T)


def fit_torque(samples: Samples, vehicle: Vehicle, curve: ThrustCurve) -> TorqueModel | None:
    """Gain, lag and offset per axis; None where the flights have no gyro or no signal per rotor, or are too short."""
    pieces = _cut(samples, vehicle, curve)
    sums = _sums(pieces)
    if sums is None or len(sums.n) < LEAST_BLOCKS:
        return None
    low, high = np.percentile(sums.fit(resampling_weights(sums.flight, DRAWS)), [2.5, 97.5], axis=1)
    estimates: Any = (part for values in zip(sums.fit()[:, 0], low, high, strict=True) for part in values)
    return TorqueModel(*(*estimates, *_held_out(pieces, sums)))


def explained(model: TorqueModel, samples: Samples, vehicle: Vehicle, curve: ThrustCurve) -> np.ndarray | None:
    """Share of the angular acceleration over HORIZON, (3,), that a fitted model predicts on flights."""
    parts = [_ahead(piece, model.gain, model.lag, model.offset) for piece in _cut(samples, vehicle, curve)]
    if not any(len(error) for error, _ in parts):
        return None
    error, change = (np.concatenate(blocks).sum(axis=0) for blocks in zip(*parts, strict=True))
    return np.asarray(1 - error / np.maximum(change, 1e-300))


def _cut(samples: Samples, vehicle: Vehicle, curve: ThrustCurve) -> list[_Piece]:
    """The stretches of the samples; [] where they have no rates or no signal per rotor."""
    if curve.signal == "thrust_acceleration" or curve.rotors != vehicle.n_rotors or samples.rate is None:
        return []
    every = max(1, -(-len(samples) // MOST_SAMPLES))
    pieces = []
    for start, stop in _pieces(samples.time, samples.segment)[::every]:
        rows = slice(start, stop)
        rotors = curve.of_signal(samples.signal[rows], None if samples.voltage is None else samples.voltage[rows])
        w = samples.rate[rows]
        geometric = geometric_acceleration(rotors, vehicle)
        if samples.held[start]:  # over the interval that ends at each sample: at the sample, the mean of both sides
            geometric = np.vstack([(geometric[:-1] + geometric[1:]) / 2, geometric[-1:]])
        pieces.append(_Piece(samples.time[rows], w, geometric, gyroscopic(w, vehicle), int(samples.flight[start])))
    return pieces


def _sums(pieces: list[_Piece]) -> _Sums | None:
    """The sums of every block; None where an axis has no motion."""
    parts = [block for piece in pieces for block in _blocks(piece)]
    if not parts:
        return None
    sums = _Sums(*(np.stack(columns) for columns in zip(*parts, strict=True)))
    return sums if (sums.yy.sum(axis=0) > 0).all() and (sums.ss.sum(axis=(0, 1)) > 0).all() else None


def _pieces(time: np.ndarray, segment: np.ndarray) -> list[tuple[int, int]]:
    """Stretches without a gap, of PIECE seconds at most."""
    step = np.diff(time)
    breaks = np.flatnonzero((np.diff(segment) != 0) | (step > 1.5 * np.median(step)) | (step <= 0)) + 1
    bounds = np.concatenate([[0], breaks, [len(time)]])
    rows = max(2, int(PIECE / np.median(step)))
    cuts = [(int(a), int(min(a + rows, stop))) for start, stop in pairwise(bounds) for a in range(start, stop, rows)]
    return [(start, stop) for start, stop in cuts if stop - start >= LEAST_ROWS]


def _blocks(piece: _Piece) -> list[tuple[np.ndarray, ...]]:
    """n, s, ss, sy, y, yy, flight of every block of one stretch."""
    reach = float(max(-LAGS[0], LAGS[-1]))
    t = piece.t
    if t[-1] - t[0] < WINDOW + 2 * reach + 0.5 * BLOCK:
        return []
    grid = t[0] + np.arange(len(t)) * (t[-1] - t[0]) / (len(t) - 1)

    def filtered(x: np.ndarray) -> np.ndarray:
        """x through the filter of the derivative."""
        whole = np.concatenate([np.zeros((1, 3)), np.cumsum((x[1:] + x[:-1]) / 2, axis=0)]) * (grid[1] - grid[0])
        return derivative(grid, whole, window=WINDOW).values

    y = derivative(grid, piece.w, window=WINDOW).values + filtered(piece.gyroscopic)
    smooth = filtered(piece.geometric)
    edge = int(np.ceil((WINDOW / 2 + reach) / (grid[1] - grid[0])))
    rows = np.arange(edge, len(grid) - edge)
    late = np.stack([np.stack([np.interp(grid[rows] - lag, grid, c) for c in smooth.T], axis=1) for lag in LAGS])
    y = y[rows]
    count = max(1, round(len(rows) * (grid[1] - grid[0]) / BLOCK))
    blocks: list[tuple[np.ndarray, ...]] = []
    for part in np.array_split(np.arange(len(rows)), count):
        a, b = late[:, part], y[part]
        da, db = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=0)
        sums = (a.sum(axis=1), (da**2).sum(axis=1), (da * db).sum(axis=1), b.sum(axis=0), (db**2).sum(axis=0))
        blocks.append((np.array(float(len(part))), *sums, np.array(piece.flight)))
    return blocks


def _ahead(piece: _Piece, gain: np.ndarray, lag: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared error of the predicted rate change over HORIZON, and squared rate change, (blocks, 3) each, summed over
    blocks of starts."""
    t, w = piece.t, piece.w
    steps = max(1, round(HORIZON / float(np.median(np.diff(t)))))
    if len(t) <= 2 * steps:
        return np.empty((0, 3)), np.empty((0, 3))
    model = _delayed(t, piece.geometric, gain, lag) - piece.gyroscopic
    tracked = _tracked(t, w, model, offset)
    whole = np.vstack([np.zeros(3), np.cumsum((model[1:] + model[:-1]) / 2 * np.diff(t)[:, None], axis=0)])
    k = np.arange(len(t) - steps)
    change = w[k + steps] - w[k]
    predicted = whole[k + steps] - whole[k] + tracked[k] * (t[k + steps] - t[k])[:, None]
    edges = np.searchsorted(t[k], np.arange(t[0], t[k[-1]], BLOCK))
    return np.add.reduceat((change - predicted) ** 2, edges), np.add.reduceat(change**2, edges)


def _held_out(pieces: list[_Piece], sums: _Sums) -> tuple[np.ndarray, np.ndarray]:
    """Share predicted on held-out data, (3,), and its lower limit: each flight in turn, or halves of a single one."""
    fold, block_fold = np.array([piece.flight for piece in pieces]), sums.flight
    if len(np.unique(sums.flight)) < 2:
        if len(pieces) < 2:
            (t, w, geometric, turned, flight), cut = pieces[0], len(pieces[0].t) // 2
            halves = (slice(0, cut), slice(cut, None))
            pieces = [_Piece(t[half], w[half], geometric[half], turned[half], flight) for half in halves]
        fold, block_fold = ((np.arange(count) >= count / 2).astype(int) for count in (len(pieces), len(sums.n)))
    tested = []
    for number in np.unique(block_fold):
        estimate = _Sums(*(values[block_fold != number] for values in sums)).fit()[:, 0]
        for piece in (pieces[i] for i in np.flatnonzero(fold == number)):
            error, change = _ahead(piece, *estimate)
            tested.append((error, change, np.full(len(error), piece.flight)))
    error, change, flights = map(np.concatenate, zip(*tested, strict=True))
    if not len(error):
        return np.zeros(3), np.zeros(3)
    share = 1 - error.sum(axis=0) / np.maximum(change.sum(axis=0), 1e-300)
    weights = resampling_weights(flights, DRAWS)
    return share, np.percentile(1 - (weights @ error) / np.maximum(weights @ change, 1e-300), 2.5, axis=0)


def torque_lines(model: TorqueModel) -> list[str]:
    """The model as text, one line per axis."""
    lines = []
    for i, axis in enumerate(AXES):
        text = (
            f"gain {model.gain[i]:.3g} [{model.gain_low[i]:.3g}, {model.gain_high[i]:.3g}] of the geometric torque,"
            f" lag {1e3 * model.lag[i]:.1f} [{1e3 * model.lag_low[i]:.1f}, {1e3 * model.lag_high[i]:.1f}] ms,"
            f" offset {model.offset[i]:.3g} [{model.offset_low[i]:.3g}, {model.offset_high[i]:.3g}] rad/s^2;"
            f" predicts {100 * model.share[i]:.0f} % of the held-out angular acceleration"
        )
        lines.append(f"torque        {axis}: {text}{'' if model.used[i] else ': not better than zero, rejected'}")
    return lines
