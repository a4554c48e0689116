"""Quantities at any time of a control period, from their values at its integration steps.

Between two steps they are interpolated, which is off by a second derivative times h^2 / 8 at most. The specific force
at a step is the mean of the two means over the steps beside it,

    f_j = (m_j + m_{j+1}) / 2,    m_j = R' ((v_j - v_{j-1}) / h - g)         see inertial.means; body, m/s^2

and a low pass of first order, for the input m_j over step j and the cut-off f_c (Hz),

    y_j = a y_{j-1} + (1 - a) m_j,    a = exp(-2 pi f_c h)
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.state import ATTITUDE, N_STATE
from quadexp.world.effect import Clock
from quadexp.world.inertial import FORCE, means

ROUNDING = 1e-6  # of an integration step, by which a time may lie beside it and count as there


class History(NamedTuple):
    """values: (k, steps + 1), as a control period begins and after every integration step."""

    values: ca.MX
    clock: Clock

    def at(self, time: Any) -> ca.MX:
        """(k,) at a time (s) since the period began: a number, or a symbol; zeros outside the period."""
        steps, place = self.clock.steps, time / self.clock.step
        if isinstance(place, ca.MX):
            return ca.mtimes(self.values, ca.fmax(1 - ca.fabs(place - ca.DM(range(steps + 1))), 0))
        later = min(max(math.ceil(place - ROUNDING), 0), steps)
        share = later - place
        if abs(share) < ROUNDING:
            return self.values[:, later]
        return share * self.values[:, later - 1] + (1 - share) * self.values[:, later]

    def state_at(self, time: Any) -> ca.MX:
        """Likewise of states: the attitude has unit length."""
        x = self.at(time)
        q = x[ATTITUDE]
        return ca.vertcat(x[: ATTITUDE.start], q / ca.norm_2(q), x[ATTITUDE.stop :])


def mean_forces(states: ca.MX, gravity: float, clock: Clock) -> ca.MX:
    """Mean specific force (3, steps) over every step, of states (13, steps + 1)."""
    symbols = [ca.SX.sym("before", N_STATE), ca.SX.sym("after", N_STATE)]
    exact = means(symbols[0], symbols[1], ca.SX(clock.step), ca.SX(gravity))
    each = ca.Function("mean_force", symbols, [ca.densify(exact[FORCE])])
    return each.map(clock.steps)(states[:, :-1], states[:, 1:])


def forces_at_steps(forces: ca.MX, first: ca.MX, last: ca.MX, clock: Clock) -> History:
    """Of the means (3, steps) and the specific forces (3,) at both ends of the period."""
    return History(ca.horzcat(first, (forces[:, :-1] + forces[:, 1:]) / 2, last), clock)


def low_passed(inputs: ca.MX, first: ca.MX, cutoff: float, clock: Clock) -> History:
    """What a low pass gives for the means (k, steps) over the steps; first: what it gave as the period began, (k,)."""
    decay = math.exp(-2 * math.pi * cutoff * clock.step)
    into, at = np.arange(clock.steps + 1)[:, None], np.arange(clock.steps + 1)
    gains = np.where(into <= at, (1 - decay) * decay ** np.maximum(at - into, 0), 0.0)
    gains[0] = decay**at
    return History(ca.mtimes(ca.horzcat(first, inputs), ca.DM(gains)), clock)


def angles(speeds: ca.MX, first: ca.MX, clock: Clock) -> History:
    """Angles of rotors (rad) from their speeds (n, steps + 1) (rad/s); first: as the period began, (n,)."""
    turned = ca.cumsum(clock.step / 2 * (speeds[:, :-1] + speeds[:, 1:]), 1)
    return History(ca.horzcat(first, ca.repmat(first, 1, clock.steps) + turned), clock)
