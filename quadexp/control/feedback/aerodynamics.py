"""Where a controller's blade-element coefficients come from: known beforehand, or identified in flight."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from quadexp.control.base import Measurement
from quadexp.physics.rotation import air_velocity
from quadexp.physics.rotor import THETA
from quadexp.physics.state import ATTITUDE, VELOCITY

SURPRISE_SAMPLES = 10  # samples over which prediction errors are averaged
FIRST_WAIT, NEXT_WAIT = 100, 50  # samples before a change is looked for: at the start, and after one was found


def body_velocity(x: np.ndarray) -> np.ndarray:
    """Velocity in the body frame, (3,), FLU (m/s), of a state (13,): a controller does not measure the wind."""
    return np.asarray(air_velocity(x[ATTITUDE], x[VELOCITY]))


class Estimator(Protocol):
    """What identifies the coefficients from sample to sample; quadexp.learn.rls.BladeElementRLS is one.

    theta: values to use, (5,). error: of the last prediction, (3,) (m/s^2). samples: updates so far. clips: samples on
    which each entry was clipped, (5,). settings.noise: assumed standard deviation of a reading (m/s^2).
    """

    theta: np.ndarray
    error: np.ndarray
    clips: np.ndarray
    samples: int

    @property
    def settings(self) -> Any:
        """How it was started and weighted."""

    def reset(self) -> None:
        """Begin anew from the first values."""

    def reopen(self) -> None:
        """Doubt the estimates as much as the first values, and keep them."""

    def update(self, body_velocity: np.ndarray, rotor_speed: np.ndarray, specific_force: np.ndarray) -> np.ndarray:
        """Take in one sample and return the values to use, (5,)."""


class KnownCoefficients:
    """Coefficients that never change.

    theta: (C_d0, C_la, C_Dx, C_Dy, C_Dz), (5,). source: for the record.
    """

    def __init__(self, theta: np.ndarray, source: str) -> None:
        self.theta, self.source = np.asarray(theta, float), source

    def reset(self) -> None:
        """Begin a flight."""

    def update(self, measurement: Measurement, rotor_speed: np.ndarray) -> None:
        """Nothing is learned."""

    def log(self) -> dict[str, float]:
        """No columns."""
        return {}


class IdentifiedCoefficients:
    """Coefficients by recursive least squares from accelerometer and rotor speeds, anew in every flight.

    change_threshold: the estimator is opened again (BladeElementRLS.reopen) where the mean square of its prediction
    errors over the last samples is this many times that of the assumed noise: the vehicle or its air has changed. None
    never does.
    """

    source = "RLS in flight"

    def __init__(self, estimator: Estimator, change_threshold: float | None = None) -> None:
        self.estimator, self.change_threshold = estimator, change_threshold
        self.reset()

    def reset(self) -> None:
        """Begin a flight with the first values."""
        self.estimator.reset()
        self.reopened, self._wait = 0, FIRST_WAIT
        self._surprise: float = 1.0

    @property
    def theta(self) -> np.ndarray:
        """The estimate as it may be used: clipped, (5,)."""
        return self.estimator.theta

    def update(self, measurement: Measurement, rotor_speed: np.ndarray) -> None:
        """Learn from a measurement; rotor_speed (n,) (rad/s). Without a reading of the accelerometer nothing is."""
        if measurement.specific_force is None:
            return
        estimator = self.estimator
        estimator.update(body_velocity(measurement.state), rotor_speed, measurement.specific_force)
        if self.change_threshold is not None and estimator.samples:
            error = estimator.error / estimator.settings.noise
            self._surprise += (float(error @ error) / 3 - self._surprise) / SURPRISE_SAMPLES
            self._wait -= 1
            if self._wait <= 0 and self._surprise > self.change_threshold:
                estimator.reopen()
                self.reopened, self._wait = self.reopened + 1, NEXT_WAIT

    def log(self) -> dict[str, float]:
        """The estimate used, by its names; how often an entry was clipped and the estimator opened again so far."""
        estimator = self.estimator
        counts = {"clips": float(estimator.clips.sum()), "reopened": float(self.reopened)}
        return {**dict(zip(THETA, estimator.theta.tolist(), strict=True)), **counts}
