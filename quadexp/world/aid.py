"""What the aids of an inertial filter have in common: a rate, a delay, and outages.

A fix is due whenever another 1 / rate has passed; it is taken at the first IMU reading from then on, whose time it
bears. Outages follow a two-state Markov chain over the fixes (Gilbert 1960): an outage begins at a fix with the
probability b and ends with the probability e,

    e = 1 / m,   b = e s / (1 - s)      s: share of fixes lost;   m = max(outage rate, 1 / (1 - s)): mean length, fixes

so that with m = 1 / (1 - s) every fix is lost with probability s, by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from quadexp.compile.symbolic import ca
from quadexp.parts.settings import Setting
from quadexp.physics.expression import Expression

RATE = "[0.1, 8000]"  # interval of a sensor's rate, Hz
SHARE = Setting("share of the fixes that are lost", "[0, 0.99]")
OUTAGE = Setting("mean length of an outage; 0: every fix is lost or not by itself", "[0, 3600]", "s")

N_CLOCK = 2  # [fixes since the last one was due, whether fixes are being lost]
N_SAMPLING = 3  # parameters: rate (Hz), thresholds of a standard normal number at which an outage begins, ends
FAR = 40.0  # beyond every standard normal number
EARLY = 1e-9  # of the interval between fixes; a fix that is this near to its time is due


class Innovation(NamedTuple):
    """One number of a fix less what the nominal state says of it.

    value: scalar. row: its derivative by the error state, {index: coefficient}. deviation: index into Aid.deviations.
    """

    value: Expression
    row: dict[int, Expression]
    deviation: int


@dataclass(frozen=True)
class Aid:
    """A sensor that fixes part of the state, and what a filter makes of its fixes.

    rate: Hz. delay: s. dropout: share of fixes lost. outage: mean length (s). size: numbers of a fix. noise: standard
    normal numbers for it. deviations: standard deviations, (s,).
    measure: of the true state x (13,), noise and deviations: a fix (size,). compare: of the nominal state (see
    quadexp.world.eskf) and a fix: innovations, whose errors are independent of each other.
    first_guess: standard deviations of the errors that the first fixes leave, by index of the error state.
    """

    name: str
    rate: float
    delay: float
    dropout: float
    outage: float
    size: int
    noise: int
    deviations: np.ndarray
    measure: Callable[[Expression, Expression, Expression], Expression]
    compare: Callable[[Expression, Expression], list[Innovation]]
    first_guess: dict[int, float]

    def sampling(self, *, outages: bool = True) -> np.ndarray:
        """Parameters of `sample`, (3,)."""
        share = self.dropout if outages else 0.0
        ends = 1 / max(self.outage * self.rate, 1 / (1 - share))
        begins = ends * share / (1 - share)
        return np.array([self.rate, *np.clip(ndtri([begins, ends]), -FAR, FAR)])


def sample(
    clock: Expression, duration: Expression, noise: Expression, parameters: Expression
) -> tuple[Expression, Expression]:
    """Whether a fix is taken and gets through (0 or 1), and the clock (2,) after another interval `duration` (s)."""
    phase = clock[0] + parameters[0] * duration
    due = phase >= 1 - EARLY
    lost = ca.if_else(clock[1] > 0, noise >= parameters[2], noise < parameters[1])
    lost = ca.if_else(due, lost, clock[1])
    return due * (1 - lost), ca.vertcat(phase - due, lost)
