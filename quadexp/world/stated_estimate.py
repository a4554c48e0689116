"""An estimate that is the truth of a while ago with white noise: what an estimator delivers, without one.

    p^ = p + n_p    v^ = v + n_v    w^ = w + n_w    q^ = q o [1, n_a / 2] / |..|        all at t - delay

n: white from sample to sample, independent on each axis. Between two integration steps the state is interpolated, which
is off by acceleration h^2 / 8 at most. Until the first delayed state is there, the state at the start holds. With
gyro=fresh the body rate is that of t: a gyroscope has no part in what makes poses late.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.parts.sensor_spec import SensorSpec, Stated, noisier
from quadexp.parts.settings import key, keyed
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.world.effect import Clock, Effect, Measured, Readings, Sizes, Start
from quadexp.world.sensors import Sensors, turned
from quadexp.world.streams import Sampled

AXES = 12  # of the noise: position, velocity, attitude, rate
ROUNDING = 1e-6  # of an integration step, by which a delay may differ from whole steps and count as such


@keyed
class StatedEstimate(Effect):
    """The truth with stated noise and delay.

    Inner states: of each control period that is still to be given, the oldest first, the two true states between which
    what is given lies. parameters: standard deviations of position, velocity, attitude and rate, (4,).
    """

    prefix = "estimator."

    position_noise: float = key(0.0, "standard deviation of the position, per axis", "[0, 10]", "m")
    velocity_noise: float = key(0.0, "standard deviation of the velocity, per axis", "[0, 10]", "m/s")
    attitude_noise: float = key(0.0, "standard deviation of the attitude, per axis", "[0, 1]", "rad")
    rate_noise: float = key(0.0, "standard deviation of the body rate, per axis", "[0, 10]", "rad/s")
    delay: float = key(0.0, "age of the state that is given", "[0, 0.5]", "s")
    gyro: Literal["late", "fresh"] = key(
        "late", "age of the given body rate: that of the rest of the state, or none, as of a gyroscope"
    )

    stage = "estimator"

    follows: bool = False  # whether sensors tell the state, and make it older by the delay themselves

    @property
    def loop_delay(self) -> float:
        return self.delay

    def among(self, effects: Sequence[Effect]) -> Effect:
        """Its noise comes on top of what sensors tell of the state."""
        if any(isinstance(effect, Sensors) and effect.tells_state for effect in effects):
            return replace(self, delay=0.0, follows=True)
        return self

    def _late(self, clock: Clock) -> tuple[int, int, float]:
        """Control periods for which two states are kept, the step of a period at which the older one is, and the share
        of the younger one, a step later."""
        late = math.ceil(self.delay / clock.step - ROUNDING)
        kept = max(math.ceil(late / clock.steps) - 1, 0)
        step = (kept + 1) * clock.steps - late
        return kept, step, late - self.delay / clock.step

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        kept, *_ = self._late(clock)
        return Sizes(2 * N_STATE * kept, parameters=4, drawn=(Sampled(AXES, (clock.period,)),))

    @property
    def _noise(self) -> tuple[float, ...]:
        return self.position_noise, self.velocity_noise, self.attitude_noise, self.rate_noise

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        kept, *_ = self._late(start.clock)
        return np.tile(start.x, 2 * kept), self._noise

    def stated(self, sensor_spec: SensorSpec, vehicle: Vehicle) -> SensorSpec:
        """Its noise; its age is stated by nobody, but for a gyroscope that is fresh."""
        gyroscope = sensor_spec.gyroscope
        if self.gyro == "fresh" and not self.follows:
            gyroscope = Stated()
        return replace(
            sensor_spec,
            position=noisier(sensor_spec.position, self.position_noise),
            velocity=noisier(sensor_spec.velocity, self.velocity_noise),
            attitude=noisier(sensor_spec.attitude, self.attitude_noise),
            gyroscope=noisier(gyroscope, self.rate_noise),
        )

    def measure(self, at: Readings, measured: Measured) -> tuple[ca.MX, Measured]:
        periods, step, share = self._late(at.clock)
        between = at.states[:, [step, min(step + 1, at.clock.steps)]]
        kept = ca.horzcat(ca.reshape(at.inner, N_STATE, 2 * periods), between)
        x = kept[:, 0]
        if share > ROUNDING:
            x = (1 - share) * x + share * kept[:, 1]
            x[ATTITUDE] /= ca.norm_2(x[ATTITUDE])
        rate = x
        if self.gyro == "fresh":
            rate = at.states[:, -1]
        if self.follows:
            x = rate = measured["state"]
        deviations = ca.vec(ca.repmat(at.parameters.T, 3, 1))
        noise = at.draws * deviations
        noisy = ca.vertcat(
            x[POSITION] + noise[:3],
            ca.if_else(at.parameters[2] > 0, turned(x[ATTITUDE], noise[6:9]), x[ATTITUDE]),
            x[VELOCITY] + noise[3:6],
            rate[RATE] + noise[9:],
        )
        return ca.vec(kept[:, 2:]), measured | {"state": noisy}

    @property
    def idle(self) -> bool:
        return not any((*self._noise, self.delay))
