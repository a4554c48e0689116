"""Source of a controller's blade-element coefficients: constant, or identified in flight."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from quadexp.physics.rotation import air_velocity
from quadexp.physics.rotor import THETA
from quadexp.physics.state import ATTITUDE, VELOCITY

INNOVATION_SAMPLES = 10  # time constant, in samples, of the mean square innovation
FIRST_WAIT, NEXT_WAIT = 100, 50  # samples without change detection: at the start, and after a detected change


def body_velocity(x: np.ndarray) -> np.ndarray:
    """Velocity in the body frame, (3,), FLU (m/s), of a state (13,), neglecting the unmeasured wind."""
    return np.asarray(air_velocity(x[ATTITUDE], x[VELOCITY]))


class Estimator(Protocol):
    """Recursive estimator of the coefficients, such as quadexp.models.rls.BladeElementRLS.

    theta: values to use, (5,). error: innovation of the last sample, (3,) (m/s^2). samples: number of updates. clips:
    number of samples on which each entry was clipped, (5,). settings.noise: assumed standard deviation of a reading
    (m/s^2).
    """

    theta: np.ndarray
    error: np.ndarray
    clips: np.ndarray
    samples: int

    @property
    def settings(self) -> Any:
        """Settings of the estimator."""

    def reset(self) -> None:
        """Restart from the initial values."""

    def reset_covariance(self) -> None:
        """Set the covariance to its initial value P_0 and keep the estimates."""

    def update(self, body_velocity: np.ndarray, rotor_speed: np.ndarray, specific_force: np.ndarray) -> np.ndarray:
        """Update with one sample; returns the values to use, (5,)."""


class KnownCoefficients:
    """Constant coefficients.

    theta: (C_d0, C_la, C_Dx, C_Dy, C_Dz), (5,). source: for the record.
    """

    def __init__(self, theta: np.ndarray, source: str) -> None:
        self.theta, self.source = np.asarray(theta, float), source

    def reset(self) -> None:
        """Begin a flight."""

    def log(self) -> dict[str, float]:
        """No columns."""
        return {}


class IdentifiedCoefficients:
    """Coefficients by recursive least squares from accelerometer and rotor speeds, restarted in every flight.

    change_threshold: detects a change of the vehicle: where the mean square innovation over the last samples exceeds
    that of the assumed noise by this factor, the covariance is reset (Estimator.reset_covariance). None: never.
    """

    source = "RLS in flight"

    def __init__(self, estimator: Estimator, change_threshold: float | None = None) -> None:
        self.estimator, self.change_threshold = estimator, change_threshold
        self.reset()

    def reset(self) -> None:
        """Begin a flight with the initial values."""
        self.estimator.reset()
        self.reopened, self._wait = 0, FIRST_WAIT
        self._innovation: float = 1.0

    @property
    def theta(self) -> np.ndarray:
        """The estimate, clipped, (5,)."""
        return self.estimator.theta

    def update(self, x: np.ndarray, specific_force: np.ndarray, rotor_speed: np.ndarray) -> None:
        """Update the estimate from a state, (13,), and readings, (3,) (m/s^2) and (n,) (rad/s)."""
        estimator = self.estimator
        estimator.update(body_velocity(x), rotor_speed, specific_force)
        if self.change_threshold is not None and estimator.samples:
            error = estimator.error / estimator.settings.noise
            self._innovation += (float(error @ error) / 3 - self._innovation) / INNOVATION_SAMPLES
            self._wait -= 1
            if self._wait <= 0 and self._innovation > self.change_threshold:
                estimator.reset_covariance()
                self.reopened, self._wait = self.reopened + 1, NEXT_WAIT

    def log(self) -> dict[str, float]:
        """The estimate by coefficient; number of clips and of covariance resets so far."""
        estimator = self.estimator
        counts = {"clips": float(estimator.clips.sum()), "reopened": float(self.reopened)}
        return {**dict(zip(THETA, estimator.theta.tolist(), strict=True)), **counts}
