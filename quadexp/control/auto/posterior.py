"""What the sums of a bank say of the age, the dead time and the lag: a posterior over a grid that closes in.

    log p(a, d, l) = sum over filters of  -tau n/2 log(sum nu^2)  -  (a + d + l) / TYPICAL  -  log lags(d + l)

n: innovations; their size is profiled out, and so are the bias of the accelerometer and a scale of the thrust, in the
gyro's filter another one that is kept near it: a scale that is wrong would be taken for a lag. tau: what an innovation
is worth, (1 - rho) / (1 + rho) where successive ones are correlated by rho, as of a first-order process. lags: how many
a total may have; without it an age would be the less likely, the more ways there are to share it between the others.
The grid is over the age, the total d + l, which is known much better than either, and the lag.

The told rates are as old as the rest of the state, or of now (`fresh`), whichever gyro and attitude say. In the second
case attitude and velocity tell the age: the velocity against readings whose noise every age adds up in another way, so
that it counts by the share of what an age changes that is not noise.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quadexp.control.auto.bank import (
    AGE,
    DEAD_TIME,
    FADING,
    LAG,
    LEAST_ATTITUDE,
    SPEEDS,
    SPINS,
    Bank,
    stationary_scalar,
)  # fmt: skip
from quadexp.control.auto.weights import command_weights, mean_weights, possible, reading_weights
from quadexp.control.delivered import INSTANT

TYPICAL = 0.03  # s, mean of the sum of all delays beforehand
STEPS = 0.005, 0.005, 0.008  # s, of ages, totals and lags
FINER, CLOSER, BESIDE = 8.0, 6, 5  # by which a grid closes in at most, how often it moves, its steps to either side
WHOLE = 1.5  # how many times as many innovations, until the noise is chosen anew, on the whole grid
FEW = 8  # pairs of total and lag, of which one tells how noisy the velocity is
STEP = 0.7  # of a grid, in deviations
ALIKE = 0.3  # logarithm of a ratio of steps that are not worth another grid
SCALE, BIAS = 0.1, 0.2  # deviations of the thrust scale, and of the accelerometer's bias (m/s^2), beforehand
TURN_BIAS = 0.02  # rad/s, of the gyroscope's bias, likewise
WORTH = 0.02, 0.5  # least and largest tau: no model is exact
FRESHER = 1.0  # log odds for rates of now
LEAST = 1e-300  # of a sum of squares, where commands did not change


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
        self._steps, self._looked = np.array(STEPS), 0
        self._fresh, self._spin, self._speed = False, 0, 0
        self._scale, self._bias = (1.0, SCALE), (np.zeros(3), np.full(3, BIAS))

    def evidence(self) -> Evidence:
        """Of the bank's sums as they are; there must be some."""
        count = self._bank.count
        whole = count >= WHOLE * self._looked
        spins = [*range(len(SPINS))] if whole else [self._spin]
        self._sums = dict(zip([*spins, -1], self._bank.products(spins), strict=True))
        ages, (age, total, _) = self._grids[0], self.best
        among = np.full(len(ages), True)
        if not whole:  # the alternatives are no delay at all, and an age for the total
            among = np.abs(np.subtract.outer(ages, (0.0, age, age + total))).min(1) < STEPS[0] - INSTANT
        J = self._joint(*self._grids, choose=whole, among=among)
        if whole:
            self._looked, self._steps = count, self._close_in(self._grids, J, np.array(STEPS))[2]
        odds = float(J.max() - J[0].max()), float(J.max() - J[:, 0].max())
        for _ in range(CLOSER):
            steps = self._steps
            about = zip(self.best, steps, STEPS, self._grids, strict=True)
            grids = [_near(best, step, whole) if step < most else whole for best, step, most, whole in about]
            mean, spread, finer, inside = self._close_in(grids, self._joint(*grids, choose=False), steps)
            if inside and (np.abs(np.log(finer / steps)) < ALIKE).all():
                break  # with the same steps again, so that weights are at hand where the best point is the same
            self._steps = finer
        deviation = np.hypot(spread, steps / 3)
        return Evidence(mean, deviation, *odds, self._fresh, self._scale, self._bias, self._spin)

    def _close_in(
        self, grids: list[np.ndarray], J: np.ndarray, steps: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
        """Mean and deviation (s) of a log posterior on grids, the steps of grids about its best point, and whether
        that is inside of these."""
        p = np.exp(J - J.max())
        p /= p.sum()
        at = np.unravel_index(int(J.argmax()), J.shape)
        self.best = tuple(float(grid[i]) for grid, i in zip(grids, at, strict=True))
        shares = p.sum((1, 2)), p.sum((0, 2)), p.sum((0, 1))
        mean = np.array([share @ grid for share, grid in zip(shares, grids, strict=True)])
        about = [(grid - centre) ** 2 for grid, centre in zip(grids, mean, strict=True)]
        spread = np.sqrt([share @ square for share, square in zip(shares, about, strict=True)])
        finer = np.clip(STEP * spread, np.maximum(np.array(STEPS) / FINER, steps / BESIDE), STEPS)
        finer[:2] = finer[:2].max()  # so that sums of age and total coincide
        axes = zip(self.best, grids, self._grids, strict=True)
        inside = not any(best in (grid[0], grid[-1]) and 0 < best < whole[-1] for best, grid, whole in axes)
        return mean, spread, finer, inside

    def early(self) -> tuple[float, float]:
        """The likeliest age by attitude and rates alone (s), and its log odds against 0."""
        ages = np.arange(0, AGE + STEPS[0] / FINER / 2, STEPS[0] / FINER)
        J = self._attitude(ages) - ages / TYPICAL
        return float(ages[J.argmax()]), float(J.max() - J[0])

    def weights(self, age: float, total: float, lag: float) -> np.ndarray:
        """For Bank.weights: of the thrust now, and of its mean over a period that ended `age` ago, (2, m)."""
        now = self._of_commands(np.array([total]), np.array([lag]))[0, 0]
        before = self._of_commands(np.array([total + age]), np.array([lag]), mean=True)[0, 0]
        return np.stack([now[::-1], before[::-1]])

    def _joint(
        self, ages: np.ndarray, totals: np.ndarray, lags: np.ndarray, *, choose: bool, among: Any = slice(None)
    ) -> np.ndarray:
        """Log posterior, but for a constant, among the ages; choose: also the likeliest noise, and whether rates are of
        now. In here, hypotheses are ages (a, 1) and the p pairs of total and lag that leave a dead time."""
        faded, pairs = self._faded, possible(totals, lags)
        W = self._of_commands(totals, lags)[pairs]
        G = self._sums[-1]
        by, square = _moments(G, W)
        prior = (G[0, 0] - 2 * by + square).min() / faded / SCALE**2
        scales = (by + prior) / (square + prior)
        thrust = np.maximum(G[0, 0] - 2 * scales * by + scales**2 * square, 0)
        at = int(thrust.argmin())
        worth = self._worth(G, scales[at] * W[at])

        if choose:
            few = np.unique(np.round((ages[:, None] + totals)[::2, ::2], 9))
            W = self._of_commands(few, lags[::3], mean=True)
            left = [
                self._sums[i][0, 0] - np.max(by_few**2 / square_few)
                for i in range(len(SPINS))
                for by_few, square_few in [_moments(self._sums[i], W)]
            ]
            self._spin = int(np.argmin(left))
        by_velocity = self._velocity(ages, totals, lags, choose=choose, among=among)
        share = self._share() if choose or self._fresh else 1.0
        ages, total = ages[among, None], totals[pairs[0]]
        likely = np.clip(total, 0.0, LAG) - np.clip(total - DEAD_TIME, 0.0, LAG)  # lags of a total, each alike
        by_thrust = worth * faded / 2 * np.log(thrust / faded + 1e-12)
        by_thrust += np.log1p(np.floor(likely / np.diff(lags).max(initial=INSTANT)))
        J = late = fresh = by_velocity - by_thrust - (ages + total) / TYPICAL
        if choose or self._fresh:  # then the velocity alone tells the age
            by_attitude = self._attitude(ages[:, 0]) - self._attitude(np.zeros(1))
            by_gyro = self._gyro(totals[None], lags, pairs, scales)
            fresh = J - (1 - share) * by_velocity + by_attitude[:, None] + by_gyro
        if choose or not self._fresh:
            late = J + self._gyro(ages + totals, lags, pairs, scales)
        if choose:
            self._fresh = bool(fresh.max() > (late - (1 - share) * by_velocity).max() + FRESHER)
        J = fresh if self._fresh else late
        at = int(J.argmax()) % len(total)
        variance = thrust[at] / faded / worth
        self._scale = float(scales[at]), float(np.sqrt(variance / (square[at] + variance / SCALE**2)))
        joint = np.full((len(ages), len(totals), len(lags)), -np.inf)
        joint[:, *pairs] = J
        return joint

    @property
    def _faded(self) -> float:
        """Periods that are in the sums over commands."""
        return (1 - np.exp(-self._bank.count * self._bank.period / FADING)) * FADING / self._bank.period

    def _gyro(self, sums: np.ndarray, lags: np.ndarray, pairs: Any, scales: np.ndarray) -> np.ndarray:
        """Log likelihood, (a, p), of the totals with the age of the rates in them, (a, t), under scales (p,)."""
        G, n = self._sums[self._spin], 2 * self._faded
        times, places = np.unique(np.round(sums, 9), return_inverse=True)
        W, at = self._of_commands(times, lags, mean=True), (places.reshape(sums.shape)[:, pairs[0]], pairs[1])
        by, square = (moment[at] for moment in _moments(G, W))
        prior = (G[0, 0] - 2 * scales * by + scales**2 * square).min() / n / SCALE**2
        scales = (by + prior * scales) / (square + prior)
        squares = np.maximum(G[0, 0] - 2 * scales * by + scales**2 * square, 0)
        k = int(squares.argmin())
        worth = self._worth(G, scales.flat[k] * W[at[0].flat[k], at[1][k % len(at[1])]])
        likelihood: np.ndarray = -worth * n / 2 * np.log(squares / n + 1e-14)
        return likelihood

    def _velocity(
        self, ages: np.ndarray, totals: np.ndarray, lags: np.ndarray, *, choose: bool, among: Any
    ) -> np.ndarray:
        """Log likelihood, (a, p). Finds the bias, and with `choose` the likeliest noise."""
        bank, readings, columns = self._bank, self._bank.layout.readings, self._bank.layout.columns
        given = bank.period, readings, bank.layout.commands
        a = reading_weights(*given, ages.tobytes(), totals.tobytes(), lags.tobytes(), bank.spans[0])[among]
        across = a[:, :1, -readings:]
        n, noise = 2 * bank.count, bank.period * bank.lateral_noise

        def of(i: int, a: np.ndarray) -> tuple[np.ndarray, ...]:
            gain = stationary_scalar(SPEEDS[i], noise)
            return _of_ages(bank.speed_sums[i], a, across, n, noise, SPEEDS[i], gain, BIAS)

        if choose:
            self._speed = min(range(len(SPEEDS)), key=lambda i: float(of(i, a[:, ::FEW])[0].min()))
        squares, even, bias, known = of(self._speed, a)
        likelihood = -n / 2 * np.log(squares / even / n + 1e-16)
        k = np.unravel_index(int(likelihood.argmax()), likelihood.shape)
        G, whole = bank.speed_sums[self._speed], np.concatenate([a[k], bias[k]])
        worth = _worth(whole @ G[:, columns:] @ whole / max(whole @ G[:, :columns] @ whole, 1e-30))
        self._bias = bias[k], np.sqrt(np.diag(known) * squares[k] / n / worth)
        # how a force goes between readings is no evidence of the commands
        weighed: np.ndarray = worth * (likelihood - likelihood.max(0))
        return weighed

    def _share(self) -> float:
        """What the likelihood of the velocity is worth where nothing else tells the age: the share of what an age
        changes that is not noise of the readings."""
        bank, readings = self._bank, self._bank.layout.readings
        noise, G = bank.period * bank.lateral_noise, bank.speed_sums[self._speed]
        now, before = mean_weights(np.array([0.0, TYPICAL]), bank.period, readings)
        apart = before - now
        both = np.concatenate([apart, np.zeros(readings), apart])
        moved = both @ G[1 : 1 + len(both), 1 : 1 + len(both)] @ both
        stays = 1 - stationary_scalar(SPEEDS[self._speed], noise)
        by_noise = 3 * bank.count * _of_noise(apart, noise, stays)
        return float(max(1 - by_noise / max(moved, 1e-30), 0.0))

    def _attitude(self, ages: np.ndarray) -> np.ndarray:
        """Log likelihood of ages (a,) of the attitude against the rates."""
        bank, columns = self._bank, self._bank.layout.turning
        since = bank.spans[1] / 2  # a rate of so long ago
        W = mean_weights(ages - since, bank.period, bank.layout.readings)
        a = np.concatenate([np.ones((len(ages), 1)), -W], axis=1)
        n, G, (reading, told) = max(3 * bank.turns, 1), bank.turn_sums, bank.turned_by
        gain = stationary_scalar(told, reading)
        squares, even, bias, _ = _of_ages(G, a, W, n, reading, told, gain, TURN_BIAS)
        k = int((squares / even).argmin())
        whole = np.concatenate([a[k], bias[k]])
        worth = _worth(whole @ G[:, columns:] @ whole / max(whole @ G[:, :columns] @ whole, 1e-30))
        likelihood: np.ndarray = -worth * n / 2 * np.log(squares / even / n + LEAST_ATTITUDE**2)
        return likelihood

    def _worth(self, G: np.ndarray, likely: np.ndarray) -> float:
        """Of an innovation, for the likeliest weights (m,)."""
        now = np.concatenate([[1, 0], -likely, [0]])
        before = np.concatenate([[0, 1], [0], -likely])
        return _worth(now @ G @ before / max(now @ G @ now, 1e-30))

    def _of_commands(self, totals: np.ndarray, lags: np.ndarray, *, mean: bool = False) -> np.ndarray:
        """See command_weights: of a reading of the accelerometer, or the mean by which two of the gyroscope differ."""
        bank = self._bank
        force, turn = bank.spans
        if mean:
            totals, force = totals + turn / 2, bank.period
        return command_weights(bank.period, bank.layout.commands, totals.tobytes(), lags.tobytes(), force)


def _near(best: float, step: float, whole: np.ndarray) -> np.ndarray:
    """A grid about the best point of another one, within the whole of it: deviations of half a step or more lie in it
    four times."""
    near = best + step * np.arange(-BESIDE, BESIDE + 1)
    inside: np.ndarray = near[(near > -INSTANT) & (near < whole[-1] + INSTANT)]
    return inside


def _worth(rho: float) -> float:
    """Of an innovation of a first-order process whose successive ones are correlated by rho."""
    return float(np.clip((1 - rho) / (1 + rho), *WORTH))


def _moments(G: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """W G_phi,y and W G_phi,phi W' of a sum G, for weights (.., m): of k W they leave G_yy - 2 k first + k^2 second."""
    slots = slice(2, 2 + W.shape[-1])
    return W @ G[0, slots], np.maximum(np.vecdot(W @ G[slots, slots], W), LEAST)


def _of_ages(
    G: np.ndarray, a: np.ndarray, noisy: np.ndarray, n: int, reading: float, told: float, gain: float, likely: float
) -> tuple[np.ndarray, ...]:
    """Of each age, by weights a (.., 1 + k) on y and phi: sum of squared innovations, what noise makes of it, in that
    of the first age, bias of the sensor (.., 3), and its covariance in units of an innovation's variance.

    G: of a bank, of n innovations. noisy: weights of readings whose noise is seen. reading, told: deviations, see
    _of_noise. gain: of the filter. likely: of the bias, beforehand.
    """
    noise = 2 * told**2 / (2 - gain) + _of_noise(noisy, reading, 1 - gain)
    k = a.shape[-1]
    by = a @ G[:k, : k + 3]
    by_a, against = np.vecdot(by[..., :k], a), by[..., k:]
    known = np.linalg.inv(G[k:, k : k + 3] + by_a.min() / n / likely**2 * np.eye(3))
    bias = -against @ known
    return np.maximum(by_a + np.vecdot(against, bias), 0), noise / noise.flat[0], bias, known


def _of_noise(W: np.ndarray, reading: float, stays: float) -> np.ndarray:
    """Variance that the noise of readings has in an innovation, (..), by weights (.., m) on them.

    reading: deviation of the velocity by one reading (m/s). The bank's filter leaves stays^i of what a reading was off
    i periods before: of an average over readings less stays in one innovation, but as much in many.
    """
    apart = np.abs(np.subtract.outer(range(W.shape[-1]), range(W.shape[-1])))
    variance: np.ndarray = reading**2 * np.vecdot(W @ stays**apart, W) / (1 - stays**2)
    return variance
