"""Set-point step.  p(t) = start before step_time, target from then on (world, m);  all derivatives zero, yaw 0.

The jump cannot be flown; it tests a controller far from its reference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.errors import UsageError
from quadexp.reference.base import N_DERIVATIVES, FlatOutput, check_point, check_positive


@dataclass(frozen=True, kw_only=True)
class Step:
    """A jump of the set-point.

    start, target: (3,), world, m. step_time, duration: s.
    Raises UsageError where a point is malformed or step_time does not lie in 0 .. duration.
    """

    start: tuple[float, float, float] = (0.0, 0.0, 1.0)
    target: tuple[float, float, float] = (1.0, 0.0, 1.0)
    step_time: float = 1.0
    duration: float = 5.0

    def __post_init__(self) -> None:
        check_positive(duration=self.duration)
        if not 0 <= self.step_time <= self.duration:
            raise UsageError(
                f"trajectory.step_time: {self.step_time!r} s is not allowed, it must lie in 0 .. {self.duration:g} s"
            )
        object.__setattr__(self, "start", check_point("start", self.start))
        object.__setattr__(self, "target", check_point("target", self.target))

    @property
    def peak_speed(self) -> float:
        return 0.0

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output."""
        t = np.atleast_1d(np.asarray(t, float))
        position = np.zeros((len(t), N_DERIVATIVES, 3))
        position[:, 0] = np.where((t >= self.step_time)[:, None], self.target, self.start)
        return FlatOutput(position, np.zeros((len(t), 3)))
