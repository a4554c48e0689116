"""Satellite navigation: position and velocity of the vehicle in the world, both with white noise.

    p_m = p + s_p n    east, north, up, m          v_m = v + s_v n    m/s

A receiver's errors are not white in truth: those of position wander over minutes (see docs/estimation.md).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from quadexp.config.sensing import GnssKeys
from quadexp.physics.expression import Expression
from quadexp.physics.state import POSITION, VELOCITY
from quadexp.world.aid import Aid, Innovation
from quadexp.world.eskf import D_POSITION, D_VELOCITY

PLACES = [*D_POSITION, *D_VELOCITY]


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
