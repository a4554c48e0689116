"""From posterior and disturbance to what is acted on: one pure function.

age               posterior mean, where the Bayes factor against none is very strong
dead time, lag    posterior mean, where it is positive
stiffness         by the timing uncertainty  sigma = sd(D) + |D - what is acted on| + sd(a) / 2, the noise of the
                  estimated position, how commands alternate, and whether rotors saturate; one grid at a time towards
                  the stiffer. Where age or total may be any larger one than those of the grid it is the softest.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from quadexp.control.mpc.settings import MPCSettings
from quadexp.plugins.auto.posterior import Posterior
from quadexp.plugins.auto.settings import BANK, DECISION


class Decision(NamedTuple):
    """What is acted on. age, dead_time, lag, timing (s): timing is the uncertainty of the commands' delay. newer: by
    how much the rates are newer than the pose (s). grid: of DECISION.grids, from 1 on; 0: the controller's own."""

    age: float = 0.0
    dead_time: float = 0.0
    lag: float = 0.0
    newer: float = 0.0
    grid: int = 0
    timing: float = 0.03

    @property
    def total(self) -> float:
        """Dead time and lag (s)."""
        return self.dead_time + self.lag


class Senses(NamedTuple):
    """What is measured beside the delays. position: noise of the estimated one (m). saturated, saturates: shares of
    commands at a limit, lately and over longer. acts: whether a disturbance is believed."""

    position: float = 0.0
    saturated: float = 0.0
    saturates: float = 0.0
    acts: bool = False


def decide(found: Posterior | None, last: Decision, senses: Senses) -> Decision:
    """What to act on from now on; found: None before there is evidence."""
    s, stiffest = DECISION, len(DECISION.grids)
    if found is None:  # the softest grid would let the error stand for a second
        return last._replace(grid=max(last.grid, int(senses.acts)))
    age, total, lag = found.mean.tolist()
    needed = s.age_odds * (1 + s.between / max(age, s.least_age))
    age = age if found.age_odds > needed and age > s.least_age else 0.0
    acted = total if found.total_odds > s.total_odds else 0.0
    lag = min(lag, acted)
    newer = min(found.newer, age)
    if abs(age - last.age) < s.least_change and abs(acted - last.total) < s.least_change:
        age, acted, lag, newer = last.age, last.total, last.lag, last.newer
    timing = float(found.deviation[1] + abs(total - acted) + found.deviation[0] / 2)
    grid = sum(timing + s.inexact * (age + acted) < one.timing for one in s.grids)
    if acted >= s.stiff_total or senses.position > s.large_noise or senses.saturates > s.saturates:
        grid = min(grid, stiffest - 1)
    grid = min(grid, last.grid + 1)
    if senses.saturated > s.saturated:
        grid = min(grid, s.middle)
    if found.at_end:
        grid = 0
    return Decision(age, acted - lag, lag, newer, grid, timing)


def known(age: float, dead_time: float, lag: float) -> Decision:
    """What is acted on once these delays (s) are known, as far as they are looked for, in the stiffest grid."""
    delays, largest = (age, dead_time, lag), (BANK.largest_age, BANK.largest_dead_time, BANK.largest_lag)
    grid = len(DECISION.grids) - (dead_time + lag >= DECISION.stiff_total)
    if any(delay > most for delay, most in zip(delays, largest, strict=True)):
        grid = 0
    age, dead_time, lag = map(min, delays, largest)
    return Decision(age, dead_time, lag, grid=grid, timing=0.0)


def grids(settings: MPCSettings) -> list[MPCSettings]:
    """Settings of each grid, the softest first, for the nodes and control period of an MPC.

    Where all its other weights are k times the usual ones or more, so is that of the position: a cost that is scaled
    has the same optimum.
    """
    of_grids, usual, factor = [settings], MPCSettings(), math.inf
    for name in ("attitude_weight", "velocity_weight", "rate_weight", "input_weight"):
        asked, least = (np.atleast_1d(getattr(one, name)) for one in (settings, usual))
        factor = min(factor, float((asked[least > 0] / least[least > 0]).min()))
    for grid in DECISION.grids:
        first = max(grid.first_node, settings.control_period)
        horizon = max(grid.horizon, settings.nodes * first)
        x, y, z = (max(grid.position_weight * max(factor, 1.0), asked) for asked in settings.position_weight)
        timed = replace(settings, first_node=first, horizon=horizon)
        of_grids.append(replace(timed, position_weight=(x, y, z), input_weight=grid.inputs * settings.input_weight))
    return of_grids
