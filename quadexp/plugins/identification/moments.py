"""Sums of products of measurements and commands over a flight, from which `timing` finds delays.

All that is compared is linear in numbers of the sample, z, with weights that depend on the delays only. So of all
samples only M = sum z z' has to be kept, and what any delays leave is b' M b: every candidate costs the same, however
long the flight. With s_j the thrust over the mass and p_j the torques of the command j + 1 periods ago, and t the time,

    thrust     z = [s_j, s_j^2, t s_j, air, f_z]          air = [1, v_b, |v_b| v_b], given velocity in body axes
    turning    z = [p_j, air, torque that the given rates need]                                    about x, about y
    velocity   z = [R_m' [change of v - g t, sums over SPAN of h R f_i and of h R e_z s_j], 1]   on each axis
    attitude   z = [turn, sums over SPAN of h R w_i, 1]                                           on each axis

R: given attitude in the middle of a period h, R_m: of a span; f_i, w_i: accelerometer and given rate i periods before
its end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from quadexp.errors import DataError
from quadexp.log.runs import period_of
from quadexp.physics.rotation import continuous
from quadexp.physics.state import ATTITUDE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

LARGEST_AGE, LARGEST_DEAD_TIME, LARGEST_LAG = 0.1, 0.1, 0.15  # s
SPAN = 0.12  # s, over which velocity and attitude are compared with their integrals
FELT = 4.0  # time constants for which a command is followed
BEGINS = 0.3  # s, after which the commands before the first are forgotten
CLOCK = 10.0  # s, unit of time within the products
N_AIR = 7  # of the air's columns
LEAST = 100  # samples
ROUND, ROUNDS = 25, 15  # steps of the half, in spans; twice as long from so many steps on
TOGETHER = 4096  # samples that are multiplied at once


@dataclass(frozen=True)
class Stream:
    """What a controller was given and has sent at k instants, a period (s) apart.

    t: (k,) (s). state: given, (k, 13). specific_force: (k, 3), body (m/s^2). command: (k, n) (N), sent at t.
    """

    t: np.ndarray
    state: np.ndarray
    specific_force: np.ndarray
    command: np.ndarray


@dataclass(frozen=True)
class Sizes:
    """How many of each there are, for a control period (s): commands, lags of readings, commands with these, span."""

    period: float

    @property
    def commands(self) -> int:
        return math.ceil((LARGEST_DEAD_TIME + LARGEST_AGE + FELT * LARGEST_LAG) / self.period - 1e-9) + 2

    @property
    def lags(self) -> int:
        return math.ceil(LARGEST_AGE / self.period - 1e-9) + 2

    @property
    def all_commands(self) -> int:
        return self.commands + self.lags

    @property
    def span(self) -> int:
        return max(round(SPAN / self.period), 2)

    @property
    def shifts(self) -> np.ndarray:
        """Candidates of an age, four in each control period (s)."""
        return self.period / 4 * np.arange(4 * math.ceil(LARGEST_AGE / self.period - 1e-9) + 1)


class Moments:
    """The sums of a stream of one flight. Raises DataError where it is too short.

    thrust, turning_x, turning_y: sums over `counted` samples. velocity, attitude: over `spans`, (3, ..) for the axes.
    half: spans of about the first half, and velocity and attitude over them.
    """

    def __init__(self, stream: Stream, vehicle: Vehicle) -> None:
        samples = len(stream.t)
        if samples < LEAST:
            raise DataError(f"delays cannot be found in {samples} samples, {LEAST} are needed")
        self.vehicle, self.sizes = vehicle, Sizes(period_of(stream.t))
        motion = _Motion(stream, vehicle, self.sizes)
        first = max(round(BEGINS / self.sizes.period), 1)
        self.counted = max(samples - first, 0)
        self.thrust = self.turning_x = self.turning_y = np.zeros(())
        for rows in _in_parts(np.arange(first, samples)):
            self.thrust = self.thrust + _products(motion.thrust(rows))
            self.turning_x = self.turning_x + _products(motion.turning(rows, 0))
            self.turning_y = self.turning_y + _products(motion.turning(rows, 1))
        spans = np.arange(self.sizes.span + self.sizes.lags, samples)
        self.spans = len(spans)
        half = half_of(self.spans)
        velocity, attitude = self._over_spans(motion, spans[:half])
        self.half = (half, velocity, attitude)
        rest = self._over_spans(motion, spans[half:])
        self.velocity, self.attitude = velocity + rest[0], attitude + rest[1]

    def _over_spans(self, motion: _Motion, spans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sums over spans that end at these samples, of velocity and of attitude."""
        sizes = self.sizes
        velocity = np.zeros((3, *2 * (sizes.lags + sizes.all_commands + 3,)))
        attitude = np.zeros((3, *2 * (sizes.lags + 3,)))
        for rows in _in_parts(spans):
            for total, z in ((velocity, motion.velocity(rows)), (attitude, motion.attitude(rows))):
                total += np.array([_products(axis) for axis in z])
        return velocity, attitude


class _Motion:
    """Rows of z at samples, of a stream; before the first sample all was as it was then."""

    def __init__(self, stream: Stream, vehicle: Vehicle, sizes: Sizes) -> None:
        from scipy.spatial.transform import Rotation

        q = continuous(stream.state[:, ATTITUDE])
        q = q / np.linalg.norm(q, axis=1, keepdims=True)
        before = np.concatenate([q[:1], q[:-1]])
        self._sizes, self._force, self._t = sizes, stream.specific_force, (stream.t - stream.t[0]) / CLOCK
        self._v, self._w = stream.state[:, VELOCITY], stream.state[:, RATE]
        self._rotation = Rotation.from_quat(q, scalar_first=True).as_matrix()
        self._middle = Rotation.from_quat(before + q, scalar_first=True).as_matrix()  # of the period before a sample
        turn = before[:, :1] * q[:, 1:] - q[:, :1] * before[:, 1:] - np.cross(q[:, 1:], before[:, 1:])
        self._turned = np.cumsum(2 * turn, axis=0)
        self._thrust = stream.command.sum(axis=1, keepdims=True) / vehicle.mass
        self._torque = stream.command @ vehicle.allocation[1:3].T
        spin = self._w @ vehicle.inertia_matrix
        self._needed = np.cross(self._w, spin)
        self._needed[1:] += np.diff(spin, axis=0) / sizes.period
        v_body = np.einsum("kji,kj->ki", self._rotation, self._v)
        self._air = np.column_stack([np.ones(len(q)), v_body, np.abs(v_body) * v_body])
        self._fallen = np.array([0.0, 0.0, vehicle.gravity * sizes.span * sizes.period])  # m/s in a span

    def thrust(self, rows: np.ndarray) -> np.ndarray:
        s = _before(self._thrust, rows - 1, self._sizes.commands)[..., 0]
        return np.column_stack([s, s**2, self._t[rows, None] * s, self._air[rows], self._force[rows, 2]])

    def turning(self, rows: np.ndarray, axis: int) -> np.ndarray:
        p = _before(self._torque[:, axis], rows - 1, self._sizes.commands)
        return np.column_stack([p, self._air[rows], self._needed[rows, axis]])

    def velocity(self, rows: np.ndarray) -> np.ndarray:
        """(3, k, ..), on the axes of the body in the middle of the span."""
        sizes = self._sizes
        steps = np.arange(rows[0] - sizes.span + 1, rows[-1] + 1)
        R = self._middle[steps]
        force = np.einsum("kij,klj->kli", R, _before(self._force, steps, sizes.lags + 1))
        pushed = _before(self._thrust, steps - 1, sizes.all_commands) * R[:, None, :, 2]
        sums = self._sums(np.concatenate([force, pushed], axis=1))
        change = self._v[rows] - self._v[rows - sizes.span] + self._fallen
        z = np.concatenate([change[:, None], sums], axis=1)
        on_body = np.einsum("kli,kij->jkl", z, self._rotation[rows - sizes.span + sizes.span // 2])
        return _with_one(on_body)

    def attitude(self, rows: np.ndarray) -> np.ndarray:
        """(3, k, ..)."""
        sizes = self._sizes
        steps = np.arange(rows[0] - sizes.span + 1, rows[-1] + 1)
        rates = np.einsum("kij,klj->kli", self._middle[steps], _before(self._w, steps, sizes.lags + 1))
        turned = self._turned[rows] - self._turned[rows - sizes.span]
        z = np.concatenate([turned[:, None], self._sums(rates)], axis=1)
        return _with_one(z.transpose(2, 0, 1))

    def _sums(self, steps: np.ndarray) -> np.ndarray:
        """Integrals over each span of what holds in each period before a sample, (k + span - 1, ..)."""
        total = np.cumsum(np.concatenate([np.zeros_like(steps[:1]), self._sizes.period * steps]), axis=0)
        return total[self._sizes.span :] - total[: -self._sizes.span]


def _before(values: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """Values at the last `count` samples until each of rows (k,), the newest first, (k, count, ..)."""
    return values[np.maximum(rows[:, None] - np.arange(count), 0)]


def _with_one(z: np.ndarray) -> np.ndarray:
    return np.concatenate([z, np.ones((*z.shape[:2], 1))], axis=2)


def _products(z: np.ndarray) -> np.ndarray:
    return z.T @ z


def _in_parts(rows: np.ndarray) -> list[np.ndarray]:
    return [part for part in np.split(rows, range(TOGETHER, len(rows), TOGETHER)) if len(part)]


def half_of(spans: int) -> int:
    """About half of them: in steps that grow with the flight, as results of earlier versions have it."""
    apart = ROUND
    while spans >= ROUNDS * apart:
        apart *= 2
    return apart * math.ceil(spans / (2 * apart) - 0.5)
