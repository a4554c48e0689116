"""Age of the estimate, dead time and lag of the commands, found in what a controller was told and has sent.

Age tau of the state. The accelerometer is read at once, so over a span of time

    v_told(t + tau) |  =  integral of R(q_told(t + tau)) f(t) + g                f: specific force

and tau is the shift for which both sides differ least. The same of the body rate: q_told(t + tau) turns by the integral
of w_told(t); a shift of 0 says that the rates are as old as the attitude.

Dead time d and lag of the commands. The accelerometer's z axis is the thrust over the mass and air: with the thrust
T(d, lag) of the commands (sent_commands.py)

    f_z = [1, T, T^2, v_b, |v_b| v_b, t T] c                          v_b: told velocity, body axes, made younger by tau

c by least squares; d and lag leave the least of f_z. So neither drag, nor a scale of the thrust, nor a battery's sag is
taken for a delay, and neither the state's age for that of the commands. A lag or a dead time alone is taken where both
are not WORTH more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.control.delay.sent_commands import SETTLED, SentCommands
from quadexp.errors import DataError
from quadexp.physics.vehicle import Vehicle

TINY = 1e-18  # of a square: exact data have no noise
SPAN = 0.12  # s, over which velocity and attitude are compared with their integrals
LARGEST_AGE, LARGEST_DEAD_TIME, LARGEST_LAG = 0.1, 0.1, 0.15  # s
WORTH = 8.0  # log likelihood that one more constant must bring to be real
WORTH_AN_AGE = 2.0  # log likelihood by which an age must be likelier than none to be one
LEAST = 100  # readings
OVERLAP = 6.0  # samples that tell the same, in spans that overlap
KNOWN, KNOWN_AGE = 0.005, 0.003  # s, standard errors up to which delays of commands and of the state count as known


@dataclass(frozen=True)
class Stream:
    """What a controller was told and has sent at k instants, a period (s) apart.

    t: (k,) (s). state: told, (k, 13). specific_force: (k, 3), body (m/s^2). command: (k, n) (N), sent at t.
    """

    t: np.ndarray
    state: np.ndarray
    specific_force: np.ndarray
    command: np.ndarray


@dataclass(frozen=True)
class Delays:
    """What was found, s; the standard error of each behind it. age: of position, velocity and attitude. gyro: how much
    younger the told body rate is than the told attitude. dead_time, lag: of the commands."""

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
        return self.age_error <= KNOWN_AGE

    @property
    def commands_known(self) -> bool:
        """Whether these data tell what makes the commands late."""
        return max(self.dead_time_error, self.lag_error) <= KNOWN

    @property
    def gyro_fresh(self) -> bool:
        """Whether the told body rate is nearer to now than to the attitude's time."""
        return self.gyro > self.age / 2


def find_delays(stream: Stream, vehicle: Vehicle) -> Delays:
    """Delays of a stream of one flight. Raises DataError where it is too short."""
    if len(stream.t) < LEAST:
        raise DataError(f"delays cannot be found in {len(stream.t)} samples, {LEAST} are needed")
    commands = _Commands(stream, vehicle)
    found, errors = commands.found()
    jumps = commands.within_periods(found)
    age, age_error = _least(lambda tau: _velocity_error(stream, tau, vehicle.gravity, jumps))
    gyro, gyro_error = _least(lambda tau: _attitude_error(stream, tau))
    return Delays(age, age_error, gyro, gyro_error, found[0], errors[0], found[1], errors[1])


def _later(t: np.ndarray, values: np.ndarray, shift: float) -> np.ndarray:
    """Rows of a stream a time later, by cubics through four samples; the last ones hold."""
    period = t[1] - t[0]
    whole = int(np.floor(shift / period + 1e-9))
    s = max(shift / period - whole, 0.0)
    k, last = np.arange(len(t)) + whole, len(t) - 1
    weights = (
        -s * (s - 1) * (s - 2) / 6,
        (s + 1) * (s - 1) * (s - 2) / 2,
        -(s + 1) * s * (s - 2) / 2,
        (s + 1) * s * (s - 1) / 6,
    )
    return sum(w * values[np.clip(k + i - 1, 0, last)] for i, w in enumerate(weights))


def _integral(t: np.ndarray, rate: np.ndarray, shift: float, beyond: Any = 0.0) -> np.ndarray:
    """Integral of a rate (k, 3) up to a time before each sample, (k, 3). What is compared with it is not interpolated,
    so that white noise there speaks for no shift. beyond: of the mean over the period before a sample, (k, 3)."""
    period = t[1] - t[0]
    mean = (rate + np.vstack([rate[:1], rate[:-1]])) / 2 + beyond
    total = np.cumsum(mean * period, axis=0)
    whole = int(np.floor(shift / period + 1e-9))
    s = 1 - max(shift / period - whole, 0.0)  # from the sample before
    k = np.arange(len(t)) - whole
    before, after = np.clip(k - 1, 0, None), np.clip(k, 0, None)
    step = total[after] - total[before]
    hermite = period * (s * (1 - s) ** 2 * rate[before] - s**2 * (1 - s) * rate[after])
    return total[before] + s**2 * (3 - 2 * s) * step + hermite


def _velocity_error(stream: Stream, tau: float, gravity: float, jumps: np.ndarray) -> np.ndarray:
    """Change of the told velocity over SPAN less the integral of the readings, (m, 3), body axes (m/s).

    An age shows where the specific force changes: on x and y, by the air; the noise of the thrust is on z.

    jumps: what the mean of f_z over the period before each sample has beyond that of its two ends, (k,) (m/s^2)."""
    state = _later(stream.t, stream.state, tau)
    a = _turned(state[:, 3:7], stream.specific_force) - [0, 0, gravity]
    up = _turned(state[:, 3:7], np.tile([0.0, 0.0, 1.0], (len(jumps), 1)))
    error = _apart(stream.t, stream.state[:, 7:10], _integral(stream.t, a, tau, up * jumps[:, None]))
    span, late = _samples(stream.t)
    middle = stream.state[late + span // 2 :, 3:7][: len(error)]
    return _centred(_turned(middle * [1, -1, -1, -1], error))


def _attitude_error(stream: Stream, tau: float) -> np.ndarray:
    """Turn of the told attitude over SPAN less the integral of the told rates, (m, 3) (rad)."""
    q, w = stream.state[:, 3:7], stream.state[:, 10:13]
    world = _turned(_later(stream.t, q, tau), w)
    steps = np.vstack([np.zeros(3), np.cumsum(_between(q[:-1], q[1:]), axis=0)])
    return _centred(_apart(stream.t, steps, _integral(stream.t, world, tau)))


def _apart(t: np.ndarray, told: np.ndarray, integral: np.ndarray) -> np.ndarray:
    """Changes over SPAN of both, and their difference, where no end of the stream is met; the same samples always."""
    span, late = _samples(t)
    error = (told[span:] - told[:-span]) - (integral[span:] - integral[:-span])
    return np.asarray(error[late : len(error) - late])


def _samples(t: np.ndarray) -> tuple[int, int]:
    """Samples of SPAN, and of what is left out at both ends of a stream."""
    period = t[1] - t[0]
    return max(round(SPAN / period), 2), int(np.ceil(LARGEST_AGE / period)) + 2


def _centred(error: np.ndarray) -> np.ndarray:
    """Without its mean on each axis: a bias of the sensor is no delay."""
    return np.asarray(error - error.mean(axis=0))


def _turned(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Body vectors (k, 3) in the world."""
    q = q / np.linalg.norm(q, axis=1)[:, None]
    cross = 2 * np.cross(q[:, 1:], v)
    return v + q[:, :1] * cross + np.cross(q[:, 1:], cross)


def _between(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Rotation vectors (k, 3) from p to q, in the axes in the middle of both, world; small angles."""
    p, q = (one / np.linalg.norm(one, axis=1)[:, None] for one in (p, q))
    w = np.sum(p * q, axis=1)
    v = p[:, :1] * q[:, 1:] - q[:, :1] * p[:, 1:] - np.cross(q[:, 1:], p[:, 1:])
    return 2 * np.sign(w)[:, None] * v


def _least(error: Callable[[float], np.ndarray]) -> tuple[float, float]:
    """Where errors, (m, 3), are likeliest in 0 .. LARGEST_AGE (s), each axis with a noise of its own, and the standard
    error (s): at least half of what the two halves of the samples differ by. None where none is nearly as likely: a
    millisecond of age that is not there is 8 mm at 8 m/s."""
    found = _minimum(error, slice(None))
    count = len(error(found))
    halves = [_minimum(error, part) for part in (slice(count // 2), slice(count // 2, None))]
    low, high = max(found - 4e-3, 0.0), found + 4e-3
    at, slope = error(found), (error(high) - error(low)) / (high - low)
    told = count / OVERLAP * np.sum(np.mean(slope**2, axis=0) / (np.mean(at**2, axis=0) + TINY))
    own = 1 / np.sqrt(max(told, 1e-30))
    none = np.mean(error(0.0) ** 2, axis=0) + TINY
    likelier = count / OVERLAP / 2 * np.sum(np.log(none / (np.mean(at**2, axis=0) + TINY)))
    doubt = max(own, abs(halves[0] - halves[1]) / 2)
    return (found, float(doubt)) if likelier >= WORTH_AN_AGE else (0.0, float(max(doubt, found / 2)))


def _minimum(error: Callable[[float], np.ndarray], part: slice) -> float:
    def unlikely(at: float) -> float:
        return float(np.sum(np.log(np.mean(np.square(error(at)[part]), axis=0) + TINY)))

    grid = np.linspace(0.0, LARGEST_AGE, 26)
    k = int(np.argmin([unlikely(float(at)) for at in grid]))
    low, high = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
    for _ in range(12):  # golden section
        a, b = high - 0.618 * (high - low), low + 0.618 * (high - low)
        low, high = (low, b) if unlikely(float(a)) < unlikely(float(b)) else (a, high)
    return float(low + high) / 2


class _Commands:
    """Thrusts of the commands of a stream beside its specific force and its rates."""

    def __init__(self, stream: Stream, vehicle: Vehicle) -> None:
        t, w = stream.t, stream.state[:, 10:13]
        self._period, self._vehicle = float(t[1] - t[0]), vehicle
        reach = LARGEST_DEAD_TIME + LARGEST_AGE + SETTLED * LARGEST_LAG
        self._history = SentCommands(vehicle.n_rotors, self._period, reach)
        m = len(self._history.values)
        before = np.concatenate([np.repeat(stream.command[:1], m, axis=0), stream.command])
        self._windows = np.lib.stride_tricks.sliding_window_view(before, m, axis=0)[: len(t)]  # (k, n, m) sent before
        v = _turned(stream.state[:, 3:7] * [1, -1, -1, -1], stream.state[:, 7:10])
        self._air = np.column_stack([np.ones(len(t)), v, np.abs(v) * v])
        self._clock = t - t.mean()
        inertia = vehicle.inertia_matrix
        momentum = np.vstack([np.zeros((1, 3)), np.diff(w, axis=0)]) / self._period @ inertia.T
        self._targets = [stream.specific_force[:, 2], *(momentum + np.cross(w, w @ inertia.T))[:, :2].T]
        self._settled = slice(min(round(0.3 / self._period), len(t) // 3), len(t))

    def _thrusts(self, spans: Any, at: Any) -> list[np.ndarray]:
        weights = self._history.weights(np.array(spans), float(at[0]), float(at[1]))
        return [self._windows @ row for row in weights]

    def _left(self, at: Any) -> np.ndarray:
        """What remains of f_z and of the torques about x and y, (3, r). at: dead time, lag, age of the rates."""
        keep, period, age = self._settled, self._period, float(at[2])
        now, mean = self._thrusts([[0.0, 0.0], [-period - age, -age]], at)
        thrust = now.sum(axis=1) / self._vehicle.mass
        designs = [np.column_stack([self._air, thrust, thrust**2, thrust * self._clock])]
        designs += [np.column_stack([self._air, mean @ self._vehicle.allocation[1 + axis]]) for axis in (0, 1)]
        return np.stack([_remains(y[keep], X[keep]) for y, X in zip(self._targets, designs, strict=True)])

    def within_periods(self, at: Any) -> np.ndarray:
        """What the mean of T / m over the period before each sample has beyond that of its two ends, (k,)."""
        now, mean = (one.sum(axis=1) for one in self._thrusts([[0.0, 0.0], [-self._period, 0.0]], at))
        return (mean - (now + np.append(now[:1], now[:-1])) / 2) / self._vehicle.mass

    def found(self) -> tuple[np.ndarray, np.ndarray]:
        """Dead time, lag and the rates' age, and the standard error of each."""
        from scipy.optimize import minimize

        largest = np.array([LARGEST_DEAD_TIME, LARGEST_LAG, LARGEST_AGE])

        def cost(at: Any) -> float:
            """Minus the log likelihood."""
            inside = np.clip(at, 0.0, largest)
            left = self._left(inside)
            rms = np.sqrt(np.mean(left**2, axis=1)) + 1e-9
            return float(left.shape[1] * np.sum(np.log(rms)) + 1e5 * np.abs(at - inside).sum())

        tried = []
        for mask in np.array([[0.0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]]):
            grid = [
                mask * at
                for at in np.array(np.meshgrid([0.005, 0.02, 0.05], [0.01, 0.04], [0.002, 0.015])).T.reshape(-1, 3)
            ]
            start = min(np.unique(grid, axis=0), key=cost)
            simplex = start + np.vstack([np.zeros(3), 0.004 * np.eye(3)])
            options = {"initial_simplex": simplex, "xatol": 2e-5, "fatol": 1e-2, "maxfev": 200}
            best = minimize(lambda at, mask=mask: cost(at * mask), start, method="Nelder-Mead", options=options).x
            tried.append(np.clip(best * mask, 0.0, largest))
        costs = [cost(at) for at in tried]
        found = next(at for at, one in zip(tried, costs, strict=True) if one <= min(costs) + WORTH)
        step, left = 1e-3, self._left(found)
        noise = np.sqrt(np.mean(left**2, axis=1, keepdims=True)) + 1e-9
        slopes = [((self._left(found + step * e) - left) / (noise * step)).ravel() for e in np.eye(3)]
        normal = np.stack(slopes) @ np.stack(slopes).T
        covariance = np.linalg.inv(normal + np.eye(3) / 0.1**2)  # 100 ms before anything is known
        together = float(found.sum() + np.sqrt(covariance.sum()))  # none is negative: none is more than all of them
        return found, np.minimum(np.sqrt(np.diag(covariance)), max(together, 0.0))


def _remains(target: np.ndarray, design: np.ndarray) -> np.ndarray:
    """What a regression leaves of a target, (r,)."""
    design = design / np.maximum(np.sqrt(np.mean(design**2, axis=0)), 1e-12)
    normal = design.T @ design + 1e-9 * len(design) * np.eye(design.shape[1])
    return target - design @ np.linalg.solve(normal, design.T @ target)
