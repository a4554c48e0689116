"""Age of the estimate, dead time and lag of the commands, found in what a controller was given and has sent.

Dead time d and lag of the commands. The accelerometer's z axis is the thrust over the mass and air: with the thrust
T(d, lag) of the commands (delivered.py), and T2 that of their squares,

    f_z = [1, T, T2, v_b, |v_b| v_b, t T] c                           v_b: given velocity, body axes

c by least squares; d and lag leave the least of f_z, and of the torques that the given rates need. So neither drag, nor
a scale of the thrust, nor a battery's sag is taken for a delay, and neither the state's age for that of the commands. A
lag or a dead time alone is taken where both are not WORTH more.

Age tau of the state. The accelerometer is read at once, so over a span of time

    v_told |  =  integral of R(q_told(t)) f(t - tau) + g              f: specific force, mean over each control period

and tau is the shift for which both sides differ least, on each axis of the body in the middle of the span against a
noise of its own: an age shows where the specific force changes, on x and y, by the air; the noise of the thrust is on
z. The same of the body rate: q_told turns by the integral of
w_told(t - tau); a shift of 0 says that the rates are as old as the attitude.

Everything is found in sums over the samples (moments.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from quadexp.plugins.identification.moments import LARGEST_AGE, LARGEST_DEAD_TIME, LARGEST_LAG, N_AIR, Moments, Sizes
from quadexp.plugins.remedies.sent_commands import SentCommands

TINY = 1e-18  # of a mean square: exact data have no noise
WORTH = 8.0  # log likelihood that one more constant must bring to be real
WITHIN = 2.0  # log likelihood of two standard errors
WORTH_AN_AGE = 2.0  # log likelihood by which an age must be likelier than none to be one
OVERLAP = 6.0  # samples that tell the same, in spans that overlap
KNOWN = 0.005  # s, standard error up to which a delay counts as known
LARGEST = np.array([LARGEST_DEAD_TIME, LARGEST_LAG, LARGEST_AGE])
MASKS = np.array([[0.0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]])  # which of dead time, lag, age of the rates there are
STARTS = np.array(np.meshgrid([0.005, 0.02, 0.05], [0.01, 0.04], [0.002, 0.015])).T.reshape(-1, 3)  # s
SMALL_STEP, NEAR = 1e-3, 4e-3  # s, of differences
CLOSE = 1e-4  # s, at which a descent ends
LEAST_NOISE = 1e-9  # keeps the logarithm finite where there is no noise
DESCENTS, TRIALS = 12, 4  # steps of a descent, and lengths that are tried for each
FINE = 400  # parts of a control period to which a shift is found
# A polynomial of the fourth degree at these parts by its values at five even ones.
BETWEEN = np.vander(np.linspace(0.0, 1.0, FINE + 1), 5) @ np.linalg.inv(np.vander(np.linspace(0.0, 1.0, 5), 5))


@dataclass(frozen=True)
class Delays:
    """What was found, s; the standard error of each behind it. age: of position, velocity and attitude. gyro: how much
    younger the given body rate is than the given attitude. dead_time, lag: of the commands."""

    age: float
    age_error: float
    gyro: float
    gyro_error: float
    dead_time: float
    dead_time_error: float
    lag: float
    lag_error: float

    @property
    def age_known(self) -> bool:
        """Whether these data tell the age."""
        return self.age_error <= KNOWN

    @property
    def commands_known(self) -> bool:
        """Whether these data tell what makes the commands late."""
        return max(self.dead_time_error, self.lag_error) <= KNOWN

    @property
    def gyro_fresh(self) -> bool:
        """Whether the given body rate is nearer to now than to the attitude's time."""
        return self.gyro > self.age / 2


class Search:
    """The search for the delays in the sums of a flight. rates_age: age of the rates by the torques (s), once `find`
    has ended."""

    def __init__(self, moments: Moments) -> None:
        self.sizes, self.rates_age, self._count = moments.sizes, 0.0, moments.counted
        self._sums = moments.thrust, moments.turning_x, moments.turning_y
        commands = self.sizes.commands
        self._sent = SentCommands(1, self.sizes.period, (commands - 1) * self.sizes.period)
        self._remaining: list[np.ndarray] = []
        first, *halves = moments.half
        totals = moments.velocity, moments.attitude
        self._velocity, self._attitude = (
            _Spans(total, half, moments.spans, first, self.sizes) for total, half in zip(totals, halves, strict=True)
        )

    def find(self) -> Delays:
        """The likeliest delays."""
        constants, errors = self._commands()
        ages = self.ages(within_periods(self.sizes, *constants[:2]))
        return Delays(*ages, constants[0], errors[0], constants[1], errors[1])

    def ages(self, mean: np.ndarray | None = None) -> tuple[float, float, float, float]:
        """Age of the state and how much younger the rates are, each with its standard error (s). mean: see
        within_periods; None: the accelerometer alone is looked at, no commands."""
        mean = np.zeros(self.sizes.commands + 1) if mean is None else mean
        return (*self._velocity.least(mean), *self._attitude.least(np.empty(0)))

    def age_likelihood(self, ages: np.ndarray) -> np.ndarray:
        """Log likelihood of ages (s) of the state, less that of the one found, when the search has ended."""
        estimate = self._velocity.likelihood(self._velocity.found)
        return np.array([self._velocity.likelihood(float(age)) - estimate for age in ages])

    def cost(self, at: np.ndarray) -> float:
        """Minus the log likelihood of dead time, lag and age of the rates, (3,) (s). Leaves what remains of the thrust
        and of the torques as weights b on z, and M b."""
        dead_time, lag, age = at
        spans = np.array([[0.0, 0.0], [-self.sizes.period - age, -age]])
        now, mean = self._sent.weights(spans, dead_time, lag)[:, ::-1, None]  # the newest first
        self._remaining = []
        cost = 0.0
        for sums, weights in zip(self._sums, ([now] * 3, [mean], [mean]), strict=True):
            columns = block_diag(*weights, np.eye(N_AIR))
            design = np.vstack([columns, np.zeros(columns.shape[1])])
            products = sums @ design
            normal, against = design.T @ products, products[-1]
            scale = np.sqrt(np.maximum(np.diag(normal), 1e-12))
            normal = normal / np.outer(scale, scale) + 1e-9 * np.eye(len(normal))
            c = np.linalg.solve(normal, against / scale) / scale
            residual = np.append(-(columns @ c), 1.0)
            along = sums[:, -1] - products @ c
            square = max(float(residual @ along), 0.0) / self._count
            cost += self._count * np.log(np.sqrt(square) + LEAST_NOISE)
            self._remaining += [residual, along]
        return float(cost)

    def _commands(self) -> tuple[list[float], list[float]]:
        """Dead time, lag and the rates' age, and the standard error of each."""
        best, least = STARTS[0], np.inf
        for start in STARTS:
            cost = self.cost(start)
            if cost < least:
                best, least = start, cost
        both = self._descend(best, MASKS[-1])
        late, ends = both[0][0] + both[0][1], []
        for mask in MASKS[:-1]:  # from there, the delay of both in one
            start = mask * np.minimum([late, late, both[0][2]], LARGEST)
            ends.append(self._descend(start, mask))
        ends.append(both)
        worth = min(cost for _, cost in ends) + WORTH
        estimate = next(at for at, cost in ends if cost <= worth)
        self.rates_age = float(estimate[2])
        _, _, normal = self._slopes(estimate)
        covariance = np.linalg.inv(normal + np.eye(3) / 0.1**2)  # 100 ms before anything is known
        together = float(estimate.sum() + np.sqrt(covariance.sum()))  # none is negative: none is more than all of them
        errors = np.minimum(np.sqrt(np.diag(covariance)), max(together, 0.0))
        return [float(number) for number in estimate], [float(number) for number in errors]

    def _slopes(self, at: np.ndarray, free: Sequence[int] | np.ndarray = (0, 1, 2)) -> tuple[float, Any, Any]:
        """Cost, its gradient and the normal matrix of what remains over its noise, by differences."""
        costs, rows = [], []
        for step in (np.zeros(3), *(SMALL_STEP * np.eye(3)[i] for i in free)):
            costs.append(self.cost(at + step))
            rows.append(self._remaining)
        gradient, normal = np.zeros(len(free)), np.zeros((len(free), len(free)))
        for i in range(0, len(rows[0]), 2):
            commands, against = (np.array([row[j] for row in rows]) for j in (i, i + 1))
            square = max(float(commands[0] @ against[0]) / self._count, 0.0)
            noise = np.sqrt(square) + LEAST_NOISE
            slopes, along = ((rows_of[1:] - rows_of[0]) / (SMALL_STEP * noise) for rows_of in (commands, against))
            gradient += slopes @ against[0] / noise
            normal += slopes @ along.T
        return costs[0], gradient, normal

    def _descend(self, at: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, float]:
        """Where the cost is least, from a candidate on, and that cost, by Levenberg and Marquardt's steps within the
        limits."""
        free, damping = np.flatnonzero(mask), 1e-3
        for _ in range(DESCENTS):
            cost, gradient, normal = self._slopes(at, free)
            for _ in range(TRIALS):
                step = np.zeros(3)
                step[free] = -np.linalg.solve(normal + np.diag(damping * np.diag(normal) + 1e-9), gradient)
                to = np.clip(at + step, 0.0, LARGEST)
                if np.abs(to - at).max() < CLOSE:
                    return at, cost
                tried = self.cost(to)
                if tried < cost:
                    break
                damping *= 10
            else:
                return at, cost
            at, cost, damping = to, tried, damping / 10
        return at, cost


class _Spans:
    """What a shift leaves of velocity or attitude over SPAN, by the sums of all spans and of the first half."""

    def __init__(self, total: np.ndarray, half: np.ndarray, count: int, first: int, sizes: Sizes) -> None:
        self._sizes = sizes
        full = total.copy()
        self.spans = count
        self._parts = [(full, count), (half, first), (full - half, count - first)]

    def _weights(self, shift: float, mean: np.ndarray) -> np.ndarray:
        """b without the constants: what is given less the integral of what was read `shift` (s) earlier."""
        lags, whole = self._sizes.lags, int(shift / self._sizes.period + 1e-9)
        s = max(shift / self._sizes.period - whole, 0.0)
        w, held = np.zeros(lags + 1), np.zeros(lags)
        w[whole : whole + 3] = (1 - s) ** 2 / 2, 0.5 + s - s * s, s * s / 2  # readings that are linear in between
        held[whole : whole + 2] = 1 - s, s
        beyond = np.convolve(held, mean) if len(mean) else mean
        return np.concatenate([[1.0], -w, -beyond])

    def _squares(self, b: np.ndarray, part: int) -> np.ndarray:
        """Means over the samples of the squares of b' z, (3,), without its mean on each axis: a bias of the sensor is
        no delay."""
        M, count = self._parts[part]
        n = len(b)
        means = M[:, n, :n] @ b / max(count, 1)
        return np.maximum(M[:, :n, :n] @ b @ b / max(count, 1) - means**2, 0.0)

    def left(self, shift: float) -> np.ndarray:
        """Mean squares that a shift (s) leaves on each axis, (3,), once `least` has ended."""
        return self._squares(self._weights(shift, self._mean), 0)

    def likelihood(self, shift: float) -> float:
        """Log likelihood of a shift (s), each axis with a noise of its own, once `least` has ended."""
        return -self.spans / OVERLAP / 2 * _unlikely(self.left(shift))

    def least(self, mean: np.ndarray) -> tuple[float, float]:
        """The likeliest shift in 0 .. LARGEST_AGE (s), each axis with a noise of its own, and its standard error (s):
        at least half of what the two halves of the samples differ by, and of what is nearly as likely. None where none
        is nearly as likely, and then at least what was found: a millisecond of age that is not there is 8 mm at 8 m/s.
        """
        grid = self._sizes.shifts
        squares = np.empty((3, len(grid), 3))
        for i, shift in enumerate(grid):
            b = self._weights(float(shift), mean)
            squares[:, i] = [self._squares(b, part) for part in range(3)]
        minimum, *halves = (_bottom(grid, cost) for cost in squares)
        low, high = max(minimum - NEAR, 0.0), min(minimum + NEAR, LARGEST_AGE)
        slope = (self._weights(high, mean) - self._weights(low, mean)) / (high - low)
        self._mean = mean
        information = self.spans / OVERLAP * np.sum(self._squares(slope, 0) / (self.left(minimum) + TINY))
        likelihood = -self.spans / OVERLAP / 2 * _unlikely(squares[0])
        near = grid[likelihood > self.likelihood(minimum) - WITHIN]  # as good as likely, where noise alone has a slope
        wide = np.abs(near - minimum).max(initial=0.0)
        error = max(1 / np.sqrt(max(information, 1e-30)), abs(halves[0] - halves[1]) / 2, wide / 2)
        if self.likelihood(minimum) - likelihood[0] < WORTH_AN_AGE:
            minimum, error = 0.0, max(error, minimum)
        self.found = minimum
        return minimum, float(error)


def _unlikely(squares: np.ndarray) -> Any:
    """Sum over the axes of the logarithms of mean squares, (.., 3)."""
    return np.log(np.maximum(squares, 0.0) + TINY).sum(axis=-1)


def _bottom(grid: np.ndarray, squares: np.ndarray) -> float:
    """The likeliest shift, to a FINE part of a period, by mean squares, (k, 3), at Sizes.shifts: within a period each
    is a polynomial of the fourth degree, which five of them determine."""
    scores = _unlikely(squares)
    i = int(np.argmin(scores))
    best, least = grid[i], scores[i]
    for first in range(max(i - 4, 0) // 4 * 4, min(i + 1, len(grid) - 4), 4):
        values = _unlikely(BETWEEN @ squares[first : first + 5])
        k = int(np.argmin(values))
        if values[k] < least:
            best, least = grid[first] + k / FINE * (grid[first + 4] - grid[first]), values[k]
    return float(best)


def within_periods(sizes: Sizes, dead_time: float, lag: float) -> np.ndarray:
    """What the mean of the thrust over a period has beyond that of its two ends, as weights on the commands."""
    sent = SentCommands(1, sizes.period, sizes.commands * sizes.period)
    mean, now = sent.weights(np.array([[-sizes.period, 0.0], [0.0, 0.0]]), dead_time, lag)[:, ::-1]
    return mean - (now + np.append(0.0, now[:-1])) / 2
