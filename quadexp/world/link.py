"""Command latency with jitter and loss.

Command k is sent at t_k and arrives at t_k + latency + jitter U_k, with U_k uniform in [0, 1); with a probability it
is lost. The vehicle flies the newest command that has arrived: one that was overtaken on its way is ignored, and a lost
one leaves the last in force. A command takes effect at the first integration step that does not begin before its
arrival. Until the first arrives the thrust of the start is in force.

Inner states: the command that everything older has come to, then for each command still kept, the newest first, its
thrusts (n,) (N) and the time of its arrival (s), NEVER where it is lost. Parameters: latency, jitter, drop.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle
from quadexp.world.effect import Clock, Effect, Moment, Sizes, Start
from quadexp.world.streams import NEVER, Sampled, on_the_way

ROUNDING = 1e-11  # s, by which a command may come before or after a step and count as coming with it


@keyed
class Latency(Effect):
    """Commands that arrive late, or not at all."""

    prefix = "link."

    latency: float = key(0.0, "least time between a command and its thrust", "[0, 0.5]", "s")
    jitter: float = key(0.0, "largest additional delay, uniform from command to command", "[0, 0.5]", "s")
    drop: float = key(0.0, "probability that a command is lost; the last one holds", "[0, 1)")

    stage = "link"

    @property
    def loop_delay(self) -> float:
        return self.latency + self.jitter / 2

    def _kept(self, clock: Clock) -> int:
        """Commands that may be on their way at a time."""
        return math.floor((self.latency + self.jitter) / clock.period + 1e-6) + 1

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        n = vehicle.n_rotors
        return Sizes(n + self._kept(clock) * (n + 1), parameters=3, drawn=(Sampled(2, (0.0,)),))

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        waiting = np.tile([*start.thrust, NEVER], self._kept(start.clock))
        return np.concatenate([start.thrust, waiting]), (self.latency, self.jitter, self.drop)

    def begin(self, at: Moment) -> Expression:
        """The oldest command is no longer kept, the new one is sent."""
        n = at.command.numel()
        base = at.inner[:n]
        oldest = at.inner[-n - 1 :]
        base = ca.if_else(oldest[n] < NEVER, oldest[:n], base)
        latency, jitter, drop = ca.vertsplit(at.parameters)
        share, lost = on_the_way(at.draws, drop)
        arrives = ca.if_else(lost, NEVER, at.t + latency + jitter * share)
        return ca.vertcat(base, at.command, arrives, at.inner[n : -n - 1])

    def thrusts(self, at: Moment) -> Expression:
        """From its arrival on, each command replaces older ones."""
        n = at.command.numel()
        acting = 0
        thrusts = 0
        base = at.inner[:n]
        for sent in ca.vertsplit(at.inner[n:], n + 1):  # the newest first; acting: share of the step from then on
            since = at.t + at.step - ROUNDING - sent[n]
            arrived = ca.fmin(since / (at.step - 2 * ROUNDING), 1)
            share = ca.fmax(acting, arrived)
            thrusts += (share - acting) * sent[:n]
            acting = share
        return thrusts + (1 - acting) * base
