"""Heading from a magnetometer: the direction of north in body axes, turned about the vertical by white noise.

    y = R(q)' Exp(-s n e_z) e_y,   e_y: north        body, unit length

It stands for a magnetometer that is corrected for declination, inclination and the vehicle's own field. Turned into
the world by the nominal attitude, R y = (c_z + s n, 1, -c_x) to first order in the attitude's error c = R dtheta in
world axes: its east component tells the error of heading at every attitude, and nothing else is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.parts.part import Part
from quadexp.parts.settings import key
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE
from quadexp.world.aid import RATE, Aid, Innovation
from quadexp.world.eskf import D_ATTITUDE


@dataclass(frozen=True, kw_only=True)
class HeadingKeys(Part):
    """North from a magnetometer; see quadexp/world/heading.py."""

    prefix: ClassVar[str] = "sensor."

    heading_rate: float = key(50.0, "readings a second, at most imu_rate", RATE, "Hz")
    heading_delay: float = key(0.0, "between the reading's time and the reading at hand", "[0, 1]", "s")
    heading_noise: float = key(0.035, "standard deviation of the heading; white", "(0, 3]", "rad")


def heading(keys: HeadingKeys) -> Aid:
    """Direction of north; its first guess is the heading of a level vehicle."""
    return Aid(
        name="heading",
        rate=keys.heading_rate,
        delay=keys.heading_delay,
        dropout=0.0,
        outage=0.0,
        size=3,
        noise=1,
        deviations=np.array([keys.heading_noise]),
        measure=_measure,
        compare=_compare,
        first_guess={D_ATTITUDE[2]: keys.heading_noise},
    )


def _measure(x: Expression, noise: Expression, deviations: Expression) -> Expression:
    error = deviations[0] * noise[0]
    return ca.mtimes(rotation_matrix(x[ATTITUDE]).T, ca.vertcat(ca.sin(error), ca.cos(error), 0))


def _compare(nominal: Expression, fix: Expression) -> list[Innovation]:
    R = rotation_matrix(nominal[ATTITUDE])
    north = ca.mtimes(R, fix)
    return [Innovation(ca.atan2(north[0], north[1]), {place: R[2, i] for i, place in enumerate(D_ATTITUDE)}, 0)]
