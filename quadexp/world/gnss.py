"""Satellite navigation: position and velocity of the vehicle in the world, both with white noise.

    p_m = p + s_p n    east, north, up, m          v_m = v + s_v n    m/s

A receiver's errors are not white in truth: those of position wander over minutes (see docs/estimation.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.parts.part import Part
from quadexp.parts.settings import Triple, key
from quadexp.physics.expression import Expression
from quadexp.physics.state import POSITION, VELOCITY
from quadexp.world.aid import OUTAGE, RATE, SHARE, Aid, Innovation
from quadexp.world.eskf import D_POSITION, D_VELOCITY

PLACES = [*D_POSITION, *D_VELOCITY]


@dataclass(frozen=True, kw_only=True)
class GnssKeys(Part):
    """Position and velocity from satellites; see quadexp/world/gnss.py."""

    prefix: ClassVar[str] = "sensor."

    gnss_rate: float = key(10.0, "fixes a second, at most imu_rate", RATE, "Hz")
    gnss_delay: float = key(0.1, "between the fix's time and the fix at hand", "[0, 2]", "s")
    gnss_position_noise: Triple = key(
        (0.0085, 0.0085, 0.015), "standard deviation of the position, east, north, up; white", "(0, 100]", "m"
    )
    gnss_velocity_noise: Triple = key(
        (0.05, 0.05, 0.05), "standard deviation of the velocity, east, north, up; white", "(0, 100]", "m/s"
    )
    gnss_dropout: float = key(0.01, SHARE)
    gnss_outage: float = key(0.5, OUTAGE)


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
