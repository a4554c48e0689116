"""Satellite navigation and a magnetometer: without it nothing tells the heading of a hovering vehicle.

    p_m = p + s_p n    east, north, up, m          v_m = v + s_v n    m/s

A receiver's errors are not white in truth: those of position wander over minutes (see docs/estimation.md).
The magnetometer gives the direction of north in body axes, turned about the vertical by white noise:

    y = R(q)' Exp(-s n e_z) e_y,   e_y: north        body, unit length

It stands for a magnetometer that is corrected for declination, inclination and the vehicle's own field. Turned into
the world by the nominal attitude, R y = (c_z + s n, 1, -c_x) to first order in the attitude's error c = R dtheta in
world axes: its east component tells the error of heading at every attitude, and nothing else is used.
"""

from __future__ import annotations

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.names import named
from quadexp.parts.settings import Triple, key, keyed
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, POSITION, VELOCITY
from quadexp.plugins.worlds.error_state import D_ATTITUDE, D_POSITION, D_VELOCITY
from quadexp.plugins.worlds.inertial import OUTAGE, RATE, SHARE, Aid, InertialSensors, Innovation

PLACES = [*D_POSITION, *D_VELOCITY]


@keyed
class ImuGnss(InertialSensors):
    """An IMU, position (m) and velocity (m/s) from satellites, and north from a magnetometer.

    The first guess of the heading is that of a level vehicle.
    """

    gnss_rate: float = key(10.0, "fixes a second, at most imu_rate", RATE, "Hz")
    gnss_delay: float = key(0.1, "delay from the fix's time to its arrival", "[0, 2]", "s")
    gnss_position_noise: Triple = key(
        (0.0085, 0.0085, 0.015), "standard deviation of the position, east, north, up; white", "(0, 100]", "m"
    )
    gnss_velocity_noise: Triple = key(
        (0.05, 0.05, 0.05), "standard deviation of the velocity, east, north, up; white", "(0, 100]", "m/s"
    )
    gnss_dropout: float = key(0.01, SHARE)
    gnss_outage: float = key(0.5, OUTAGE)
    heading_rate: float = key(50.0, "readings a second, at most imu_rate", RATE, "Hz")
    heading_delay: float = key(0.0, "delay from the reading's time to its arrival", "[0, 1]", "s")
    heading_noise: float = key(0.035, "standard deviation of the heading; white", "(0, 3]", "rad")

    @property
    def aids(self) -> tuple[Aid, ...]:
        deviations = np.array([*self.gnss_position_noise, *self.gnss_velocity_noise])
        gnss = Aid(
            name="gnss",
            rate=self.gnss_rate,
            delay=self.gnss_delay,
            dropout=self.gnss_dropout,
            outage=self.gnss_outage,
            size=6,
            noise=6,
            deviations=deviations,
            measure=_measure,
            compare=_compare,
            first_guess=named(PLACES, deviations.tolist()),
        )
        heading = Aid(
            name="heading",
            rate=self.heading_rate,
            delay=self.heading_delay,
            dropout=0.0,
            outage=0.0,
            size=3,
            noise=1,
            deviations=np.array([self.heading_noise]),
            measure=_measure_north,
            compare=_compare_north,
            first_guess={D_ATTITUDE[2]: self.heading_noise},
        )
        return gnss, heading


def _measure(x: Expression, noise: Expression, deviations: Expression) -> Expression:
    return ca.vertcat(x[POSITION], x[VELOCITY]) + deviations * noise


def _compare(nominal: Expression, fix: Expression) -> list[Innovation]:
    away = fix - ca.vertcat(nominal[POSITION], nominal[VELOCITY])
    return [Innovation(away[i], {place: 1}, i) for i, place in enumerate(PLACES)]


def _measure_north(x: Expression, noise: Expression, deviations: Expression) -> Expression:
    error = deviations[0] * noise[0]
    return rotation_matrix(x[ATTITUDE]).T @ ca.vertcat(ca.sin(error), ca.cos(error), 0)


def _compare_north(nominal: Expression, fix: Expression) -> list[Innovation]:
    R = rotation_matrix(nominal[ATTITUDE])
    north = R @ fix
    return [Innovation(ca.atan2(north[0], north[1]), {place: R[2, i] for i, place in enumerate(D_ATTITUDE)}, 0)]
