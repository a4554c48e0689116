"""Command latency with jitter and loss.

Command k is sent at t_k and arrives at t_k + latency + jitter U_k, with U_k uniform in [0, 1); with a probability it
is lost. The vehicle flies the newest command that has arrived: one that was overtaken on its way is ignored, and a lost
one leaves the last in force. A command takes effect at the first integration step that does not begin before its
arrival. Until the first arrives the rotors stand at hover.

Inner states: the command that everything older has come to, then for each command still kept, the newest first, its
thrusts (n,) (N) and the time of its arrival (s), NEVER where it is lost. Parameters: latency, jitter, drop.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from quadexp.config.world import LatencyKeys
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle
from quadexp.world.effect import Clock, Effect, Moment, Sizes, Start

NEVER = 1e9  # s
ROUNDING = 1e-9  # s, by which a command may come late and still be in time


@dataclass(frozen=True)
class Latency(LatencyKeys, Effect):
    """See LatencyKeys."""

    stage = "link"

    @property
    def loop_delay(self) -> float:
        """See Effect.loop_delay."""
        return self.latency + self.jitter / 2

    def _kept(self, clock: Clock) -> int:
        """Commands that may be on their way at a time."""
        return math.floor((self.latency + self.jitter) / clock.period + 1e-6) + 1

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        """See Effect.sizes."""
        n = vehicle.n_rotors
        return Sizes(inner=n + self._kept(clock) * (n + 1), parameters=3, draws=2)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        """See Effect.start."""
        n, kept = start.vehicle.n_rotors, self._kept(start.clock)
        hover = np.full(n, start.vehicle.hover_thrust)
        return np.concatenate([hover, np.tile([*hover, NEVER], kept)]), (self.latency, self.jitter, self.drop)

    @staticmethod
    def _commands(inner: Expression, n: int) -> Iterator[tuple[Expression, Expression]]:
        """(thrusts (n,), time of their arrival (s)), the oldest first."""
        for first in range(inner.numel() - n - 1, n - 1, -n - 1):
            yield inner[first : first + n], inner[first + n]

    def begin(self, at: Moment) -> Expression:
        """See Effect.begin: the oldest command is no longer kept, the new one is sent."""
        n = at.command.numel()
        oldest, arrival = next(self._commands(at.inner, n))
        base = ca.if_else(arrival <= at.t + ROUNDING, oldest, at.inner[:n])
        uniform = (1 + ca.erf(at.draws / math.sqrt(2))) / 2
        latency, jitter, drop = ca.vertsplit(at.parameters)
        arrives = ca.if_else(uniform[1] < drop, NEVER, at.t + latency + jitter * uniform[0])
        return ca.vertcat(base, at.command, arrives, at.inner[n : -n - 1])

    def thrusts(self, at: Moment) -> Expression:
        """See Effect.thrusts."""
        n = at.command.numel()
        found = at.inner[:n]
        for thrusts, arrival in self._commands(at.inner, n):
            found = ca.if_else(arrival <= at.t + ROUNDING, thrusts, found)
        return found
