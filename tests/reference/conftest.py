"""An analytic trajectory for the trajectory tests."""

import numpy as np
import pytest

from quadexp.reference.base import FlatOutput


class Wave:
    """A smooth moving path with moving yaw; every derivative of a sine is a sine."""

    duration = 10.0
    peak_speed = 4.0

    def __init__(self, yaw: bool = True) -> None:
        self.yaw = yaw

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        t = np.atleast_1d(t)
        inside = (t >= 0) & (t <= self.duration)
        t = np.clip(t, 0, self.duration)
        amplitude, rate = np.array([2.0, 1.5, 0.8]), np.array([1.1, 1.6, 0.9])
        phase = np.array([0.0, 0.5, 1.0])
        position = np.stack(
            [amplitude * rate**n * np.sin(np.outer(t, rate) + phase + n * np.pi / 2) for n in range(5)], axis=1
        )
        position[~inside, 1:] = 0
        yaw = np.stack([0.6 * 0.8**n * np.sin(0.8 * t + 0.3 + n * np.pi / 2) for n in range(3)], axis=1)
        yaw[~inside, 1:] = 0
        return FlatOutput(position, yaw if self.yaw else None)


@pytest.fixture
def wave() -> Wave:
    return Wave()
