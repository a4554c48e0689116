"""An estimate that is the truth of a while ago with white noise: what an estimator delivers, without one.

    p^ = p + n_p    v^ = v + n_v    w^ = w + n_w    q^ = q o [1, n_a / 2] / |..|        all at t - delay

n: white from sample to sample, independent on each axis. The delay is a whole number of integration steps, the nearest
one. Until the first delayed state is there, the state at the start holds. With gyro=fresh the body rate is that of t:
a gyroscope has no part in what makes poses late.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from quadexp.config.world import StatedEstimateKeys
from quadexp.physics.rotation import left_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.world.effect import Clock, Effect, Readings, Sizes, Start, Told

AXES = 12  # of the noise: position, velocity, attitude, rate


@dataclass(frozen=True)
class StatedEstimate(StatedEstimateKeys, Effect):
    """See StatedEstimateKeys. Inner states: the true states of the last `delay`, the oldest first. parameters: standard
    deviations of position, velocity, attitude and rate, (4,)."""

    stage = "estimator"

    @property
    def loop_delay(self) -> float:
        """See Effect.loop_delay."""
        return self.delay

    def _late(self, clock: Clock) -> int:
        return round(self.delay / clock.step)

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        """See Effect.sizes."""
        return Sizes(inner=N_STATE * self._late(clock), parameters=4, draws=AXES)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        """See Effect.start."""
        noise = (self.position_noise, self.velocity_noise, self.attitude_noise, self.rate_noise)
        return np.tile(start.x, self._late(start.clock)), noise

    def measure(self, at: Readings, told: Told) -> tuple[ca.MX, Told]:
        """See Effect.measure."""
        late, steps = self._late(at.clock), at.clock.steps
        past, now = ca.reshape(at.inner, N_STATE, late), at.states[:, 1:]
        x = past[:, steps - 1] if late >= steps else now[:, steps - 1 - late]
        rate = now[:, -1] if self.gyro == "fresh" else x
        kept = ca.horzcat(past[:, steps:], now) if late > steps else now[:, steps - late :]
        noise = at.draws * ca.vertcat(*(ca.repmat(std, 3, 1) for std in ca.vertsplit(at.parameters)))
        turned = ca.mtimes(left_matrix(x[ATTITUDE]), ca.vertcat(1, noise[6:9] / 2))
        noisy = ca.vertcat(
            x[POSITION] + noise[:3],
            ca.if_else(at.parameters[2] > 0, turned / ca.norm_2(turned), x[ATTITUDE]),
            x[VELOCITY] + noise[3:6],
            rate[RATE] + noise[9:],
        )
        return ca.reshape(kept, N_STATE * late, 1), told | {"state": noisy}
