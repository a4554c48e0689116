"""Motion capture: position and attitude, both with white noise.

    p_m = p + s_p n        world, m
    q_m = q o Exp(s_q n)   about body axes, rad

A filter compares p_m - p and Log(q* o q_m), which to first order are the errors of position and attitude themselves.
"""

from __future__ import annotations

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import exponential, product
from quadexp.physics.state import ATTITUDE, POSITION
from quadexp.plugins.worlds.error_state import D_ATTITUDE, D_POSITION, D_VELOCITY
from quadexp.plugins.worlds.inertial import OUTAGE, RATE, SHARE, Aid, InertialSensors, Innovation
from quadexp.plugins.worlds.rotation_vector import conjugate, logarithm


@keyed
class ImuMocap(InertialSensors):
    """An IMU and motion capture: position (m) and attitude; its first velocity is that between two poses."""

    pose_rate: float = key(100.0, "poses a second, at most imu_rate", RATE, "Hz")
    pose_delay: float = key(0.01, "between the exposure and the pose at hand", "[0, 1]", "s")
    pose_position_noise: float = key(1e-3, "standard deviation of the position, each axis", "(0, 10]", "m")
    pose_attitude_noise: float = key(5e-3, "standard deviation of the attitude, about each body axis", "(0, 1]", "rad")
    pose_dropout: float = key(0.01, SHARE)
    pose_outage: float = key(0.05, OUTAGE)

    @property
    def aids(self) -> tuple[Aid, ...]:
        position = self.pose_position_noise
        attitude = self.pose_attitude_noise
        velocity = float(np.sqrt(2)) * position * self.pose_rate
        pose = Aid(
            name="pose",
            rate=self.pose_rate,
            delay=self.pose_delay,
            dropout=self.pose_dropout,
            outage=self.pose_outage,
            size=7,
            noise=6,
            deviations=np.array([position, attitude]),
            measure=_measure,
            compare=_compare,
            first_guess={**dict.fromkeys(D_POSITION, position), **dict.fromkeys(D_VELOCITY, velocity)}
            | dict.fromkeys(D_ATTITUDE, attitude),
        )
        return (pose,)


def _measure(x: Expression, noise: Expression, deviations: Expression) -> Expression:
    turned = exponential(deviations[1] * noise[3:])
    return ca.vertcat(x[POSITION] + deviations[0] * noise[:3], product(x[ATTITUDE], turned))


def _compare(nominal: Expression, fix: Expression) -> list[Innovation]:
    away = fix[:3] - nominal[POSITION]
    turned = logarithm(product(conjugate(nominal[ATTITUDE]), fix[3:]))
    innovations = [Innovation(away[i], {place: 1}, 0) for i, place in enumerate(D_POSITION)]
    return innovations + [Innovation(turned[i], {place: 1}, 1) for i, place in enumerate(D_ATTITUDE)]
