"""Set-point step.  p(t) = start before step_time, target from then on (world, m);  all derivatives zero, yaw 0.

The jump cannot be flown; it tests a controller far from its reference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.config.flight import StepKeys
from quadexp.errors import UsageError
from quadexp.reference.base import N_DERIVATIVES, FlatOutput


@dataclass(frozen=True, kw_only=True)
class Step(StepKeys):
    """A jump of the set-point; settings: see StepKeys.

    Raises UsageError where a point is malformed or step_time does not lie in 0 .. duration.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.step_time <= self.duration:
            raise UsageError(
                f"trajectory.step_time: {self.step_time!r} s is not allowed, it must lie in 0 .. {self.duration:g} s"
            )

    @property
    def peak_speed(self) -> float:
        return 0.0

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output."""
        t = np.atleast_1d(np.asarray(t, float))
        position = np.zeros((len(t), N_DERIVATIVES, 3))
        position[:, 0] = np.where((t >= self.step_time)[:, None], self.target, self.start)
        return FlatOutput(position, np.zeros((len(t), 3)))
