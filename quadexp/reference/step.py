"""Set-point step.  p(t) = start before step_time, target from then on (world, m);  all derivatives zero, yaw 0.

The jump cannot be flown; it tests a controller far from its reference.
"""

from __future__ import annotations

import numpy as np

from quadexp.errors import UsageError
from quadexp.parts.settings import Triple, key, keyed
from quadexp.reference.base import DURATION, FlatOutput, TrajectoryPart, standing


@keyed
class Step(TrajectoryPart):
    """A jump of the set-point.

    Raises UsageError where a point is malformed or step_time does not lie in 0 .. duration.
    """

    former_kind = "step"

    start: Triple = key(
        (0.0, 0.0, 1.0), "set-point before the step, where the flight starts, world", "[-1e6, 1e6]", "m"
    )
    target: Triple = key((1.0, 0.0, 1.0), "set-point after the step, world", "[-1e6, 1e6]", "m")
    step_time: float = key(1.0, "time of the step", "[0, 3600]", "s")
    duration: float = key(5.0, DURATION)

    def check_together(self) -> None:
        if not 0 <= self.step_time <= self.duration:
            raise UsageError(
                f"trajectory.step_time: {self.step_time!r} s is not allowed, it must lie in 0 .. {self.duration:g} s"
            )

    @property
    def peak_speed(self) -> float:
        return 0.0

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        after = np.atleast_1d(np.asarray(t, float)) >= self.step_time
        return standing(np.where(after[:, None], self.target, self.start))
