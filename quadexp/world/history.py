"""Quantities at any time of a control period, from their values at its integration steps.

Between two steps they are interpolated, which is off by a second derivative times h^2 / 8 at most.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import unit
from quadexp.physics.low_pass import low_pass
from quadexp.world.effect import Clock

ROUNDING = 1e-6  # of an integration step, by which a time may lie beside it and count as there


class History(NamedTuple):
    """values: (k, steps + 1), as a control period begins and after every integration step."""

    values: ca.MX
    clock: Clock

    def at(self, time: Any) -> ca.MX:
        """(k,) at a time (s) since the period began: a number, or a symbol; zeros outside the period."""
        steps = self.clock.steps
        place = time / self.clock.step
        if isinstance(place, ca.MX):
            away = abs(place - ca.DM(range(steps + 1)))
            return self.values @ ca.fmax(1 - away, 0)
        later = min(max(math.ceil(place - ROUNDING), 0), steps)
        share = later - place
        if abs(share) < ROUNDING:
            return self.values[:, later]
        before = share * self.values[:, later - 1]
        return before + (1 - share) * self.values[:, later]

    def unit_at(self, time: Any) -> ca.MX:
        """Likewise, of unit length: of attitudes."""
        return unit(self.at(time))

    def low_passed(self, first: ca.MX, cutoff: float) -> History:
        """What a low pass makes of it (physics/low_pass.py); first: what it gave as the period began, (k,). cutoff: Hz;
        0: none."""
        if not cutoff:
            return self
        decay, before, now = low_pass(cutoff, self.clock.step)
        driven = before * self.values[:, :-1] + now * self.values[:, 1:]
        steps = np.arange(self.clock.steps + 1)
        elapsed = steps - steps[:, None]
        gains = np.where(elapsed >= 0, decay ** np.maximum(elapsed, 0), 0.0)
        passed = ca.horzcat(first, driven) @ ca.DM(gains)
        return History(passed, self.clock)

    def integral(self, first: ca.MX) -> History:
        """first, (k,), and what has come to it since the period began."""
        means = (self.values[:, :-1] + self.values[:, 1:]) / 2
        nothing = ca.MX.zeros(first.numel())
        gained = self.clock.step * ca.cumsum(ca.horzcat(nothing, means), 1)
        values = ca.repmat(first, 1, self.clock.steps + 1) + gained
        return History(values, self.clock)
