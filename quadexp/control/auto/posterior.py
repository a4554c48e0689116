"""What the sums of a bank say of the age, the dead time and the lag: a posterior over a grid that closes in.

    log p(a, d, l) = sum over filters of  -tau n/2 log(sum nu^2)  -  (a + d + l) / TYPICAL

n: innovations; their size is profiled out, and so are the bias of the accelerometer and a scale of the thrust, in the
gyro's filter another one that is kept near it: a scale that is wrong would be taken for a lag. tau: what an innovation
is worth, (1 - rho) / (1 + rho) where successive ones are correlated by rho, as of a first-order process. The grid is
over the age, the total d + l, which is known much better than either, and the lag.

The told rates are as old as the rest of the state, or of now (`fresh`), whichever gyro and attitude say. In the second
case attitude and velocity tell the age: the velocity against readings whose noise every age adds up in another way, so
that it counts by the share of what an age changes that is not noise.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from quadexp.control.auto.bank import (
    AGE,
    DEAD_TIME,
    FADING,
    LAG,
    LEAST_ATTITUDE,
    SPEEDS,
    Bank,
    stationary_scalar,
)  # fmt: skip
from quadexp.control.delivered import INSTANT, NO_LAG

TYPICAL = 0.03  # s, mean of the sum of all delays beforehand
STEPS = 0.005, 0.005, 0.008  # s, of ages, totals and lags
FINER, CLOSER, BESIDE = 8.0, 5, 8  # by which a grid closes in, how often it moves, and its steps to either side then
SCALE, BIAS = 0.1, 0.2  # deviations of the thrust scale, and of the accelerometer's bias (m/s^2), beforehand
TURN_BIAS = 0.02  # rad/s, of the gyroscope's bias, likewise
WORTH = 0.02, 0.5  # least and largest tau: no model is exact
FRESHER = 1.0  # log odds for rates of now


class Evidence(NamedTuple):
    """What is known of the delays.

    mean, deviation: of age, total and lag (s). late, slow: log odds of the likeliest age, and of the likeliest total,
    against 0. fresh: whether the told rates are of now. scale: of the thrust, bias: of the accelerometer (3,) (m/s^2),
    both with deviations. spin: which of SPINS.
    """

    mean: np.ndarray
    deviation: np.ndarray
    late: float
    slow: float
    fresh: bool
    scale: tuple[float, float]
    bias: tuple[np.ndarray, np.ndarray]
    spin: int


class Posterior:
    """Over the hypotheses of a bank; `reset` begins a flight."""

    def __init__(self, bank: Bank) -> None:
        self._bank = bank
        largest = AGE, DEAD_TIME + LAG, LAG
        self._grids = [np.arange(0, most + step / 2, step) for most, step in zip(largest, STEPS, strict=True)]
        self.reset()

    def reset(self) -> None:
        """Nothing is known."""
        self.best: tuple[float, ...] = (0.0, TYPICAL, 0.0)
        self._fresh, self._spin, self._speed = False, 0, 0
        self._scale, self._bias = (1.0, SCALE), (np.zeros(3), np.full(3, BIAS))

    def evidence(self) -> Evidence:
        """Of the bank's sums as they are; there must be some."""
        grids, steps, most = list(self._grids), np.array(STEPS), [grid[-1] for grid in self._grids]
        late = slow = 0.0
        for closer in range(CLOSER):
            J = self._joint(*grids, choose=not closer)
            p = np.exp(J - J.max())
            p /= p.sum()
            if not closer:
                late, slow = float(J.max() - J[0].max()), float(J.max() - J[:, 0].max())
            at = np.unravel_index(int(J.argmax()), J.shape)
            self.best = tuple(float(grid[i]) for grid, i in zip(grids, at, strict=True))
            shares = p.sum((1, 2)), p.sum((0, 2)), p.sum((0, 1))
            mean = np.array([share @ grid for share, grid in zip(shares, grids, strict=True)])
            about = [(grid - centre) ** 2 for grid, centre in zip(grids, mean, strict=True)]
            spread = np.sqrt([share @ square for share, square in zip(shares, about, strict=True)])
            finer = (spread < steps) & (steps == STEPS)
            steps[finer] /= FINER
            axes = zip(self.best, grids, most, strict=True)
            ends = [best in (grid[0], grid[-1]) and 0 < best < top for best, grid, top in axes]
            if not (finer | ends).any():
                break
            for i in np.flatnonzero((steps < STEPS) & (finer | np.any(ends))):
                near = self.best[i] + steps[i] * np.arange(-BESIDE, BESIDE + 1)
                grids[i] = near[(near > -INSTANT) & (near < most[i] + INSTANT)]
        deviation = np.hypot(spread, steps / 2)
        return Evidence(mean, deviation, late, slow, self._fresh, self._scale, self._bias, self._spin)

    def early(self) -> tuple[float, float]:
        """The likeliest age by attitude and rates alone (s), and its log odds against 0."""
        ages = np.arange(0, AGE + STEPS[0] / FINER / 2, STEPS[0] / FINER)
        J = self._attitude(ages) - ages / TYPICAL
        return float(ages[J.argmax()]), float(J.max() - J[0])

    def weights(self, age: float, total: float, lag: float) -> np.ndarray:
        """For Bank.weights: of the thrust now, and of its mean over a period that ended `age` ago, (2, m)."""
        now = self._of_commands(np.array([total]), np.array([lag]), mean=False)[0, 0]
        before = self._of_commands(np.array([total + age]), np.array([lag]), mean=True)[0, 0]
        return np.stack([now[::-1], before[::-1]])

    def _joint(self, ages: np.ndarray, totals: np.ndarray, lags: np.ndarray, *, choose: bool) -> np.ndarray:
        """Log posterior, but for a constant; choose: also the likeliest noise, and whether rates are of now."""
        bank = self._bank
        faded = self._faded
        W = self._of_commands(totals, lags, mean=False)
        G = bank.sums[-1]
        by, square = _moments(G, W)
        prior = (G[0, 0] - 2 * by + square).min() / faded / SCALE**2
        scales = (by + prior) / (square + prior)
        thrust = np.maximum(G[0, 0] - 2 * scales * by + scales**2 * square, 0)
        at = np.unravel_index(int(thrust.argmin()), thrust.shape)
        worth = self._worth(G, scales[at] * W[at])

        if choose:
            few = np.unique(np.round((ages[:, None] + totals)[::2, ::2], 9))
            W = self._of_commands(few, lags[::3], mean=True)
            least = [G[0, 0] - np.max(by**2 / square) for G in bank.sums[:-1] for by, square in [_moments(G, W)]]
            self._spin = int(np.argmin(least))
        by_velocity, share = self._velocity(ages, choose=choose)
        by_velocity, by_attitude = by_velocity[:, None, None], self._attitude(ages)[:, None, None]
        rest = by_velocity - worth * faded / 2 * np.log(thrust / faded + 1e-12)
        rest = rest - (ages[:, None, None] + totals[:, None]) / TYPICAL
        waits = totals[:, None] - lags
        J = np.where((waits < -INSTANT) | (waits > DEAD_TIME + INSTANT), -np.inf, rest)
        late = fresh = np.full_like(J, -np.inf)
        if choose or self._fresh:  # then the velocity alone tells the age
            fresh = J - (1 - share) * by_velocity + by_attitude + self._gyro(totals[None], lags, scales)
        if choose or not self._fresh:
            late = J + self._attitude(np.zeros(1)) + self._gyro(ages[:, None] + totals, lags, scales)
        if choose:
            self._fresh = bool(fresh.max() > (late - (1 - share) * by_velocity).max() + FRESHER)
        J = fresh if self._fresh else late
        at = np.unravel_index(int(J.argmax()), J.shape)[1:]
        variance = thrust[at] / faded / worth
        self._scale = float(scales[at]), float(np.sqrt(variance / (square[at] + variance / SCALE**2)))
        return J

    @property
    def _faded(self) -> float:
        """Periods that are in the sums over commands."""
        return (1 - np.exp(-self._bank.count * self._bank.period / FADING)) * FADING / self._bank.period

    def _gyro(self, sums: np.ndarray, lags: np.ndarray, scales: np.ndarray) -> np.ndarray:
        """Log likelihood, (a, t, l), of the totals with the age of the rates in them, (a, t), under scales (t, l)."""
        G, n = self._bank.sums[self._spin], 2 * self._faded
        times, places = np.unique(np.round(sums, 9), return_inverse=True)
        W, places = self._of_commands(times, lags, mean=True), places.reshape(sums.shape)
        by, square = (moment[places] for moment in _moments(G, W))
        prior = (G[0, 0] - 2 * scales * by + scales**2 * square).min() / n / SCALE**2
        scales = (by + prior * scales) / (square + prior)
        squares = np.maximum(G[0, 0] - 2 * scales * by + scales**2 * square, 0)
        a, t, k = np.unravel_index(int(squares.argmin()), squares.shape)
        worth = self._worth(G, scales[a, t, k] * W[places[a, t], k])
        likelihood: np.ndarray = -worth * n / 2 * np.log(squares / n + 1e-14)
        return likelihood

    def _velocity(self, ages: np.ndarray, *, choose: bool) -> tuple[np.ndarray, float]:
        """Log likelihood of ages (a,), and what it is worth where nothing else tells the age: the share of what an age
        changes that is not noise of the readings. Finds the bias, and with `choose` the likeliest noise."""
        bank, readings, columns = self._bank, self._bank.layout.readings, self._bank.layout.columns
        W = np.stack([_of_readings(age, bank.period, readings) for age in ages])
        n = 2 * bank.part("speed_count")[0]
        likelihoods, now = {}, _of_readings(0.0, bank.period, readings)
        for i in range(len(SPEEDS)) if choose else [self._speed]:
            squares, even, bias, known = _of_ages(
                bank.speed_sums[i], W, now, n, bank.period * bank.noise, SPEEDS[i], BIAS
            )
            likelihoods[i] = -n / 2 * np.log(squares / even / n + 1e-16), squares, bias, known
        self._speed = max(likelihoods, key=lambda i: float(likelihoods[i][0].max()))
        likelihood, squares, bias, known = likelihoods[self._speed]
        k = int(likelihood.argmax())
        G, whole = bank.speed_sums[self._speed], np.concatenate([[1], -W[k], bias[k]])
        worth = _worth(whole @ G[:columns, columns:] @ whole / max(whole @ G[:columns, :columns] @ whole, 1e-30))
        self._bias = bias[k], np.sqrt(np.diag(known) * squares[k] / n / worth)
        apart = _of_readings(TYPICAL, bank.period, readings) - now
        moved = apart @ G[1 : 1 + readings, 1 : 1 + readings] @ apart
        by_noise = 1.5 * n * _of_noise(apart[None], bank.period * bank.noise, SPEEDS[self._speed])[0]
        return worth * likelihood, float(max(1 - by_noise / max(moved, 1e-30), 0.0))

    def _attitude(self, ages: np.ndarray) -> np.ndarray:
        """Log likelihood of ages (a,) of the attitude against the rates."""
        bank, columns = self._bank, self._bank.layout.columns
        now, *W = (_of_readings(age, bank.period, bank.layout.readings) for age in (0.0, *ages))
        n, G = 3 * bank.turns, bank.turn_sums
        squares, even, bias, _ = _of_ages(G, np.array(W), now, n, *bank.turned_by, TURN_BIAS)
        k = int((squares / even).argmin())
        whole = np.concatenate([[1], -W[k], bias[k]])
        worth = _worth(whole @ G[:columns, columns:] @ whole / max(whole @ G[:columns, :columns] @ whole, 1e-30))
        likelihood: np.ndarray = -worth * n / 2 * np.log(squares / even / n + LEAST_ATTITUDE**2)
        return likelihood

    def _worth(self, G: np.ndarray, likely: np.ndarray) -> float:
        """Of an innovation, for the likeliest weights (m,)."""
        now = np.concatenate([[1, 0], -likely, [0]])
        before = np.concatenate([[0, 1], [0], -likely])
        return _worth(now @ G @ before / max(now @ G @ now, 1e-30))

    def _of_commands(self, totals: np.ndarray, lags: np.ndarray, *, mean: bool) -> np.ndarray:
        """See command_weights."""
        given = self._bank.period, self._bank.layout.commands, totals.tobytes(), lags.tobytes()
        return command_weights(*given, mean=mean)


@lru_cache(maxsize=64)
def command_weights(period: float, count: int, totals: bytes, lags: bytes, *, mean: bool) -> np.ndarray:
    """Weights (t, l, m) on m = count commands, the newest first, as of control.delivered: of the thrust now, or of its
    mean over the last period. totals, lags: bytes of arrays (t,), (l,) (s); a total is a dead time and the lag."""
    total, lag = np.frombuffer(totals)[:, None, None], np.frombuffer(lags)[:, None]
    begin = -period if mean else -INSTANT
    acts = np.maximum(total - lag, 0.0) - period * np.arange(1, count + 1)
    constant = np.maximum(lag, NO_LAG)

    def response(x: np.ndarray) -> np.ndarray:
        x = np.maximum(x, 0)
        return x + constant * np.expm1(-x / constant)

    passed = (response(-acts) - response(begin - acts)) / -begin
    passed[..., -1] = 1.0
    return np.diff(passed, axis=-1, prepend=0.0)


def _worth(rho: float) -> float:
    """Of an innovation of a first-order process whose successive ones are correlated by rho."""
    return float(np.clip((1 - rho) / (1 + rho), *WORTH))


def _moments(G: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """W G_phi,y and W G_phi,phi W' of a sum G, for weights (.., m): of k W they leave G_yy - 2 k first + k^2 second."""
    slots = slice(2, 2 + W.shape[-1])
    return W @ G[0, slots], ((W @ G[slots, slots]) * W).sum(-1)


def _of_ages(
    G: np.ndarray, W: np.ndarray, now: np.ndarray, n: int, reading: float, told: float, likely: float
) -> tuple[np.ndarray, ...]:
    """Of each age, by weights (a, k) on readings: sum of squared innovations, what noise makes of it against an age of
    0, with weights now (k,), bias of the sensor (a, 3), and its covariance in units of an innovation's variance.

    G: of a bank, of n innovations. reading, told: deviations, see _of_noise. likely: of the bias, beforehand.
    """
    noise = 2 * told**2 / (2 - stationary_scalar(told, reading)) + _of_noise(np.vstack([now, W]), reading, told)
    plain, turned = slice(0, 1 + W.shape[1]), slice(1 + W.shape[1], 4 + W.shape[1])
    a = np.hstack([np.ones((len(W), 1)), -W])
    by_a, against = ((a @ G[plain, plain]) * a).sum(1), a @ G[plain, turned]
    known = np.linalg.inv(G[turned, turned] + by_a.min() / n / likely**2 * np.eye(3))
    bias = -against @ known
    return np.maximum(by_a + (against * bias).sum(1), 0), noise[1:] / noise[0], bias, known


def _of_noise(W: np.ndarray, reading: float, speed: float) -> np.ndarray:
    """Variance that the noise of readings has in an innovation of the velocity, (k,), by weights (k, m) on them.

    reading: deviation of the velocity by one reading, speed: of a told one (m/s). The bank's filter leaves b^i of what
    a reading was off i periods before: of an average over readings less stays in one innovation, but as much in many.
    """
    stays = 1 - stationary_scalar(speed, reading)
    apart = np.abs(np.subtract.outer(range(W.shape[1]), range(W.shape[1])))
    variance: np.ndarray = reading**2 * ((W @ stays**apart) * W).sum(1) / (1 - stays**2)
    return variance


def _of_readings(age: float, period: float, count: int) -> np.ndarray:
    """Weights on readings, the newest first, of their mean over a period that ended `age` ago, linear between them."""
    weights, k = np.zeros(count), int(age / period + 1e-9)
    r = age / period - k
    weights[k : k + 3] = (1 - r) ** 2 / 2, 0.5 + r - r * r, r * r / 2
    return weights
