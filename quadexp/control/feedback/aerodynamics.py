"""Where a controller's blade-element coefficients come from: known beforehand, or identified in flight."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from quadexp.control.base import Measurement
from quadexp.rotor import THETA
from quadexp.state import ATTITUDE, VELOCITY

if TYPE_CHECKING:
    from quadexp.identify.rls import BladeElementRLS

SURPRISE_SAMPLES = 10  # samples over which prediction errors are averaged
FIRST_WAIT, NEXT_WAIT = 100, 50  # samples before a change is looked for: at the start, and after one was found


def body_velocity(x: np.ndarray) -> np.ndarray:
    """Velocity in the body frame, (3,), FLU (m/s), of a state (13,)."""
    w, a, b, c = x[ATTITUDE].tolist()
    vx, vy, vz = x[VELOCITY].tolist()
    return np.array(
        [
            (1 - 2 * (b * b + c * c)) * vx + 2 * (a * b + w * c) * vy + 2 * (a * c - w * b) * vz,
            2 * (a * b - w * c) * vx + (1 - 2 * (a * a + c * c)) * vy + 2 * (b * c + w * a) * vz,
            2 * (a * c + w * b) * vx + 2 * (b * c - w * a) * vy + (1 - 2 * (a * a + b * b)) * vz,
        ]
    )


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

    def __init__(self, estimator: BladeElementRLS, change_threshold: float | None = None) -> None:
        self.estimator, self.change_threshold = estimator, change_threshold
        self.reset()

    def reset(self) -> None:
        """Begin a flight with the first values."""
        self.estimator.reset()
        self.reopened, self._surprise, self._wait = 0, 1.0, FIRST_WAIT

    @property
    def theta(self) -> np.ndarray:
        """The estimate as it may be used: clipped, (5,)."""
        return self.estimator.theta

    def update(self, measurement: Measurement, rotor_speed: np.ndarray) -> None:
        """Learn from a measurement; rotor_speed (n,) (rad/s)."""
        estimator = self.estimator
        estimator.update(body_velocity(measurement.state), rotor_speed, measurement.specific_force)
        if self.change_threshold is not None and estimator.samples:
            error = estimator.error / estimator.settings.noise
            self._surprise += (error @ error / 3 - self._surprise) / SURPRISE_SAMPLES
            self._wait -= 1
            if self._wait <= 0 and self._surprise > self.change_threshold:
                estimator.reopen()
                self.reopened, self._wait = self.reopened + 1, NEXT_WAIT

    def log(self) -> dict[str, float]:
        """The estimate used, by its names; how often an entry was clipped and the estimator opened again so far."""
        estimator = self.estimator
        counts = {"clips": float(estimator.clips.sum()), "reopened": float(self.reopened)}
        return {**dict(zip(THETA, estimator.theta.tolist(), strict=True)), **counts}
