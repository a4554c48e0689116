"""Smooth random flights as trajectories, and the same flights turned or mirrored."""

import numpy as np

from quadexp.reference.base import FlatOutput
from tests.properties.strategies import make_state

DURATION = 1.5  # s


class Wander:
    """A sum of sines in every axis and in the heading; yaw False: free heading."""

    duration = DURATION
    peak_speed = 5.0

    def __init__(self, rng: np.random.Generator, *, yaw: bool = True, size: float = 1.0) -> None:
        self.amplitude = size * rng.uniform(0.3, 1.2, 4) * [1, 1, 0.4, 0.6]
        self.rate, self.phase = rng.uniform(0.6, 2.0, 4), rng.uniform(0, 6, 4)
        self.yaw = yaw

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        t = np.atleast_1d(np.asarray(t, float))
        inside, t = (t >= 0) & (t <= self.duration), np.clip(t, 0, self.duration)
        waves = np.stack(
            [
                self.amplitude * self.rate**k * np.sin(np.outer(t, self.rate) + self.phase + k * np.pi / 2)
                for k in range(5)
            ],
            axis=1,
        )
        waves[~inside, 1:] = 0
        return FlatOutput(waves[:, :, :3], waves[:, :3, 3] if self.yaw else None)


class Transformed:
    """Another trajectory, its positions multiplied by a matrix, its heading by a sign and shifted by an angle (rad)."""

    def __init__(self, path, matrix: np.ndarray, *, sign: float = 1.0, angle: float = 0.0) -> None:
        self.path, self.matrix, self.sign, self.angle = path, matrix, sign, angle
        self.duration, self.peak_speed = path.duration, path.peak_speed

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        flat = self.path.flat_output(t)
        yaw = None if flat.yaw is None else self.sign * flat.yaw + [self.angle, 0, 0]
        return FlatOutput(flat.position @ self.matrix.T, yaw)


def near(state: np.ndarray, rng: np.random.Generator, distance: float = 0.2) -> np.ndarray:
    """A state some way off another."""
    x = state + distance * (make_state(rng, speed=1.0, rate=0.5) * np.r_[np.ones(3), 0.2 * np.ones(4), np.ones(6)])
    x[3:7] /= np.linalg.norm(x[3:7])
    return x
