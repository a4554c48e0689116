"""Satellite navigation: position and velocity of the vehicle in the world, both with white noise.

    p_m = p + s_p n    east, north, up, m          v_m = v + s_v n    m/s

A receiver's errors are not white in truth: those of position wander over minutes (see docs/estimation.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.parts.part import Part
from quadexp.parts.settings import Setting, Triple
from quadexp.physics.expression import Expression
from quadexp.physics.state import POSITION, VELOCITY
from quadexp.world.aid import OUTAGE, RATE, SHARE, Aid, Innovation
from quadexp.world.eskf import D_POSITION, D_VELOCITY

PLACES = [*D_POSITION, *D_VELOCITY]


@dataclass(frozen=True, kw_only=True)
class GnssKeys(Part):
    """Position and velocity from satellites; see quadexp/world/gnss.py."""

    prefix: ClassVar[str] = "sensor."

    gnss_rate: Annotated[float, Setting("fixes a second, at most imu_rate", RATE, "Hz")] = 10.0
    gnss_delay: Annotated[float, Setting("between the fix's time and the fix at hand", "[0, 2]", "s")] = 0.1
    gnss_position_noise: Annotated[
        Triple, Setting("standard deviation of the position, east, north, up; white", "(0, 100]", "m")
    ] = (0.0085, 0.0085, 0.015)
    gnss_velocity_noise: Annotated[
        Triple, Setting("standard deviation of the velocity, east, north, up; white", "(0, 100]", "m/s")
    ] = (0.05, 0.05, 0.05)
    gnss_dropout: Annotated[float, SHARE] = 0.01
    gnss_outage: Annotated[float, OUTAGE] = 0.5


def gnss(keys: GnssKeys) -> Aid:
    """Position (m) and velocity (m/s)."""
    deviations = np.array([*keys.gnss_position_noise, *keys.gnss_velocity_noise])
    return Aid(
        name="gnss",
        rate=keys.gnss_rate,
        delay=keys.gnss_delay,
        dropout=keys.gnss_dropout,
        outage=keys.gnss_outage,
        size=6,
        noise=6,
        deviations=deviations,
        measure=_measure,
        compare=_compare,
        first_guess=dict(zip(PLACES, deviations.tolist(), strict=True)),
    )


def _measure(x: Expression, noise: Expression, deviations: Expression) -> Expression:
    return ca.vertcat(x[POSITION], x[VELOCITY]) + deviations * noise


def _compare(nominal: Expression, fix: Expression) -> list[Innovation]:
    away = fix - ca.vertcat(nominal[POSITION], nominal[VELOCITY])
    return [Innovation(away[i], {place: 1}, i) for i, place in enumerate(PLACES)]
