"""What the data sheets of a vehicle's sensors say: all that a controller may know of its sensors before a flight.

Made by the world that is flown (`World.sensor_spec`) and handed to controllers and remedies as
`BuildContext.sensor_spec`. It says nothing of links, motors, air or load, and nothing of the delay of an estimator
(estimator.delay), which no data sheet states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from quadexp.parts.former import names_of


@dataclass(frozen=True)
class Stated:
    """One sensor. SI units, body or world axes as in the state; attitude: rotation about body axes (rad).

    noise: standard deviation of the white noise of one reading, of the worst axis; of rotor speeds relative to them.
    drift: standard deviation of what is correlated in time: a bias as the flight begins, or a slow error.
    rate: readings a second (Hz); 0: one at every control instant. delay: mean age (s) of a reading that is just given;
    None: not stated. span: over which a reading is a mean (s), as of an IMU's increments; its driver knows that.
    """

    noise: float = 0.0
    drift: float = 0.0
    rate: float = 0.0
    delay: float | None = 0.0
    span: float = 0.0

    def within(self, period: float) -> float:
        """The span where the readings of a control period (s) are a whole number."""
        return period / math.ceil(period / self.span - 1e-9) if self.span else 0.0

    def scaled(self, factor: float) -> Stated:
        """The specification of somebody who is wrong by a factor in noise, drift and delay."""
        delay = None if self.delay is None else factor * self.delay
        return replace(self, noise=factor * self.noise, drift=factor * self.drift, delay=delay)


def noisier(sensor: Stated | None, noise: float) -> Stated | None:
    """A sensor with further white noise of that standard deviation."""
    return None if sensor is None else replace(sensor, noise=math.hypot(sensor.noise, noise))


STATE_ALONE = Stated(delay=None)  # of a state that comes from nobody knows where, without stated errors


@dataclass(frozen=True)
class SensorSpec:
    """What is stated of each sensor; None: there is none. gyroscope: the body rates that are given in the state."""

    accelerometer: Stated | None = Stated()
    gyroscope: Stated | None = STATE_ALONE
    rotor_speed: Stated | None = None
    position: Stated | None = STATE_ALONE
    velocity: Stated | None = STATE_ALONE
    attitude: Stated | None = STATE_ALONE


__getattr__ = names_of(__name__)
