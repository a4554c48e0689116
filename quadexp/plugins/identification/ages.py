"""Age of the state that a controller was given, by an accelerometer and a gyroscope that are read at once.

Over a span of time the given velocity changes by the integral of the readings, turned by the given attitude:

    v(t) - v(t - SPAN) = integral of R(q(t)) f(t - tau) + g         f: specific force, R, v, q: as given

The age of position, velocity and attitude is the tau for which both sides differ least, each axis of the body with a
noise of its own: an age shows where the force changes, along x and y by the air; the noise of the thrust is along z.
The same of the attitude, which turns by the integral of R(q(t)) w(t - tau): its tau is how much younger the given body
rates are than the attitude, 0 where they are as old.

Readings are linear between samples. Where the commands and what makes them late are known, the thrust that they give
within a period is integrated as it is, and what is read besides is linear.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.log.runs import period_of

LARGEST_AGE = 0.1  # s
STEP = 1e-3  # s, between the ages that are tried first
SPAN = 0.12  # s
OVERLAP = 6.0  # samples that tell the same, in spans that overlap
WITHIN = 2.0  # log likelihood of two standard errors
WORTH = 2.0  # log likelihood by which an age must be likelier than none to be one
TINY = 1e-18  # of a mean square: exact data have no noise
LEAST = 100  # samples
Integral = Callable[[np.ndarray], np.ndarray]  # times (k,) (s) -> integral of a reading until then, (k, 3)


class Stream(NamedTuple):
    """What a controller was given and has read at k instants, evenly spaced. t: (k,) (s). velocity: given, (k, 3),
    world (m/s). attitude: given, k of them. rate: given, (k, 3), body (rad/s). force: read, (k, 3), body (m/s^2)."""

    t: np.ndarray
    velocity: np.ndarray
    attitude: Rotation
    rate: np.ndarray
    force: np.ndarray


class Age(NamedTuple):
    """value, error: the likeliest shift and its standard error (s). tried: (j,) (s). likelihood: of each, log less that
    of the likeliest, (j,)."""

    value: float
    error: float
    tried: np.ndarray
    likelihood: np.ndarray


def integral_of(t: np.ndarray, reading: np.ndarray) -> Integral:
    """Of a reading (k, 3) that is linear between its times (k,); before the first it is the first."""
    return make_interp_spline(t, reading, k=1).antiderivative()


def integral_of_force(stream: Stream, thrust: Integral, thrust_now: np.ndarray) -> Integral:
    """The same of the specific force. thrust: integral of the thrust per mass, (j,) -> (j,). thrust_now: (k,), at t."""
    beside = stream.force.copy()
    beside[:, 2] -= thrust_now
    linear = integral_of(stream.t, beside)

    def integral(t: np.ndarray) -> np.ndarray:
        total = linear(t)
        total[:, 2] += thrust(t)
        return total

    return integral


def age_of_state(stream: Stream, gravity: float, force: Integral | None = None) -> Age:
    """Of position, velocity and attitude. force: integral of the specific force; None: linear between the readings."""
    by_gravity = gravity * np.diff(stream.t)[:, None] * [0.0, 0.0, 1.0]
    gained = np.diff(stream.velocity, axis=0) + by_gravity
    return _likeliest(stream, gained, force or integral_of(stream.t, stream.force))


def age_of_rates(stream: Stream) -> Age:
    """How much younger the given body rates are than the given attitude."""
    turned = (stream.attitude[1:] * stream.attitude[:-1].inv()).as_rotvec()
    return _likeliest(stream, turned, integral_of(stream.t, stream.rate))


def _likeliest(stream: Stream, change: np.ndarray, integral: Integral) -> Age:
    """The shift of a reading. change: of what it integrates to, over each period, (k - 1, 3), world.

    The error is that of the slope (the Cramer-Rao bound), at least half of what the halves of the flight differ by, and
    of the range that is about as likely. An age that is not WORTH more than none is none, and its error at least what
    was found."""
    t = stream.t
    if len(t) < LEAST:
        raise DataError(f"delays cannot be found in {len(t)} samples, {LEAST} are needed")
    period = period_of(t)
    span = max(round(SPAN / period), 2)
    first = int(np.ceil(LARGEST_AGE / period)) + 1  # before, a late reading is of the time before the flight
    turns = (stream.attitude[1:] * stream.attitude[:-1].inv()).as_rotvec()
    middle = Rotation.from_rotvec(turns / 2) * stream.attitude[:-1]
    body = stream.attitude[first + span // 2 : len(t) - span + span // 2].inv()  # in the middle of each span
    half = len(body) // 2

    def errors(shift: float) -> np.ndarray:
        """What a shift leaves of each span, (s, 3), on the axes of the body."""
        read = np.diff(integral(np.maximum(t - shift, t[0])), axis=0)
        remaining = np.cumsum(change - middle.apply(read), axis=0)[first - 1 :]
        return body.apply(remaining[span:] - remaining[:-span])

    def likelihoods(shift: float) -> np.ndarray:
        """Log, by the whole flight and by each half of it, (3,)."""
        error = errors(shift)
        logs = []
        for part in (error, error[:half], error[half:]):
            variance = np.var(part, axis=0)  # about the mean: a bias of the sensor is no age
            logs.append(-len(part) / OVERLAP / 2 * np.log(variance + TINY).sum())
        return np.array(logs)

    def peak(part: int) -> tuple[float, float]:
        """The likeliest shift and its likelihood, beside the best of those tried."""
        near = tried[tried_likelihoods[:, part].argmax()]
        bounds = np.clip([near - STEP, near + STEP], 0.0, LARGEST_AGE)
        best = minimize_scalar(lambda shift: -likelihoods(shift)[part], bounds=bounds, method="bounded")
        return float(best.x), -float(best.fun)

    tried = np.arange(0.0, LARGEST_AGE + STEP / 2, STEP)
    tried_likelihoods = np.array([likelihoods(shift) for shift in tried])
    value, highest = peak(0)
    likelihood = tried_likelihoods[:, 0] - highest
    alike = tried[likelihood > -WITHIN]
    remaining = errors(value)
    slope = (errors(value + STEP) - remaining) / STEP
    signal_to_noise = np.var(slope, axis=0) / (np.var(remaining, axis=0) + TINY)
    information = len(body) / OVERLAP * np.sum(signal_to_noise)
    between_halves = abs(peak(1)[0] - peak(2)[0])
    range_or_halves = max(between_halves, np.abs(alike - value).max(initial=0.0))
    error = max(information**-0.5, range_or_halves / 2)
    if likelihood[0] > -WORTH:
        error = max(error, value)
        value = 0.0
    return Age(value, float(error), tried, likelihood)
