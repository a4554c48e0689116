"""The thrust that the rotors deliver, as far as a controller can know it.

Where rotor speeds W are measured and the vehicle's thrust coefficient is stated, it is c_t W^2. Otherwise it follows
from the commands: one that was sent at t_j acts over [t_j + d, t_j + d + T], d the dead time and T the control period,
and the thrust follows it with a first-order lag (physics.motor).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression
from quadexp.physics.motor import decayed


@dataclass(frozen=True)
class Delays:
    """What is known of the commands' way to thrust: control period, dead time, lag of the rotors (s)."""

    period: float
    dead_time: float
    lag: float

    @property
    def pending(self) -> int:
        """Commands that have been sent and have not acted for their whole period."""
        return max(math.ceil(self.dead_time / self.period - 1e-9), 0)

    @property
    def durations(self) -> tuple[float, float]:
        """For how long the oldest pending command, and the next one, act in a control period (s)."""
        first = self.dead_time - (self.pending - 1) * self.period
        return (first, self.period - first) if self.pending else (self.period, 0.0)

    @property
    def numbers(self) -> np.ndarray:
        """For `delivered_by_commands`: the durations' shares of the period, the decays over them, the lag in periods,
        and whether there is a lag."""
        decays = [math.exp(-d / self.lag) if self.lag else float(not d) for d in self.durations]
        shares = [d / self.period for d in self.durations]
        return np.array([*shares, *decays, self.lag / self.period, float(self.lag > 0)])


def delivered_by_commands(
    commands: Expression, thrust: Expression, sent: Expression, numbers: Expression
) -> tuple[Expression, Expression, Expression]:
    """One control period: pending commands (n, K) and thrust (n,) after it, and the mean thrust over it (N).

    commands, thrust: before it. sent: the command that was sent at its beginning, (n,) (N). numbers: of Delays.
    """
    acting = ca.horzcat(commands, sent)
    first = thrust
    mean = 0
    for i in range(min(acting.size2(), 2)):
        u = acting[:, i]
        after = decayed(thrust, u, numbers[2 + i])
        mean = mean + numbers[i] * u
        thrust = after
    return acting[:, 1:], thrust, mean + numbers[4] * (first - thrust)


def delivered_thrust(
    kept: Mapping[str, Any], sent: Any, numbers: Any, measured: Any = None, turning: Any = 0
) -> tuple[Any, Any, dict[str, Any]]:
    """Thrusts now and their mean over the last control period, (n,) each (N), and of `kept` the next values; symbols.

    kept: commands, that are pending, (n K,); thrust, by commands, (n,); before, thrusts as they were measured a period
    ago and whether they were, (n + 1,). sent: the command of a period ago, (n,). numbers: of Delays. measured: thrusts
    by rotor speeds, (n,); None: never. turning: whether they are measured now. The mean of measured thrusts is that
    of the two ends where the rotors lag.
    """
    n = sent.numel()
    commands = ca.reshape(kept["commands"], n, kept["commands"].numel() // n)
    commands, thrust, mean = delivered_by_commands(commands, kept["thrust"], sent, numbers)
    next_values = {"commands": ca.vec(commands), "thrust": thrust}
    if measured is None:
        return thrust, mean, next_values
    before = kept["before"][:n]
    had = kept["before"][n]
    now = turning * measured + (1 - turning) * thrust
    share = turning * had * numbers[-1] / 2  # of the thrusts a period ago
    mean = turning * (share * before + (1 - share) * measured) + (1 - turning) * mean
    return now, mean, next_values | {"before": ca.vertcat(measured, turning)}


def kept_sizes(rotors: int, delays: Delays) -> dict[str, int]:
    """Numbers of what `delivered_thrust` keeps, and of `sent`."""
    return {"commands": rotors * delays.pending, "thrust": rotors, "before": rotors + 1, "sent": rotors}
