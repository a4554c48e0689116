"""A channel: one measured quantity on its way from the vehicle to the controller.

    y_i = x(s_i) + b(s_i) + sigma n_i              what is read at the time s_i;  n_i white, standard normal
    b' = a b + g n                                 every 10 ms; the drift, held in between
    arrival s_i + delay + jitter U_i, or never, with the probability `drop`;  U_i uniform in [0, 1)

The controller is given the newest reading that has arrived, until a newer one has; one that was overtaken is ignored.
With a rate, s_i = i / rate; without, every control instant t has a reading of its own, taken at t - delay. The drift is

    a = 1, g = walk sqrt(10 ms)                    random walk
    a = exp(-10 ms / T), g = S sqrt(1 - a^2)       first-order Gauss-Markov process of deviation S: S^2 exp(-|tau| / T)

White noise, drift, and jitter with losses have a random stream each, by time (streams.py): they are the same at every
control rate. Until the first reading arrives, the exact one of the start holds.

Inner states: the drift; when what is given was taken (s), and what is given; of a channel whose readings wait the
reading that everything older has come to, likewise, and every reading on its way, the oldest first: when it arrives
(s), when it was taken, and itself. Parameters: deviations of the white noise, bias, then a, g, delay, jitter, drop.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.names import named
from quadexp.parts.settings import keyed
from quadexp.physics.expression import split
from quadexp.world.effect import Clock, Readings, Sizes
from quadexp.world.streams import NEVER, Drawn, Sampled, Ticking, on_the_way

DRIFT = 0.01  # s, for which a drift is held
ROUNDING = 1e-9  # s, by which a reading may arrive later and count as there
WHOLE = 1e-6  # of a control period or an integration step
MOST = 200  # readings in a control period


@keyed
class Channel:
    """size: numbers of a reading; errors: of its error, which an attitude has fewer of.

    noise, bias: deviation of the white noise, and constant error, (errors,). first: deviation of the drift as a flight
    begins. decay, gain: a and g. rate: Hz, 0 for none. delay, jitter: s. message: that it comes in, whose jitter and
    losses it shares. add: the reading of an exact value, a slow and a random error, as symbols.
    """

    name: str
    size: int
    noise: np.ndarray
    bias: np.ndarray
    first: float
    decay: float
    gain: float
    rate: float
    delay: float
    jitter: float
    drop: float
    message: str
    add: Callable[[Any, Any, Any], Any]

    @property
    def errors(self) -> int:
        return len(self.noise)

    @property
    def drifts(self) -> bool:
        return bool(self.first or self.gain)

    @property
    def waits(self) -> bool:
        """Whether a reading may not be given at the instant at which it is taken, or not be taken at every one."""
        return bool(self.rate or self.delay or self.jitter or self.drop)

    @property
    def taken(self) -> int:
        """Which inner state says when the given reading was taken; what is given stands behind it."""
        return self.errors * self.drifts

    def _offset(self, clock: Clock) -> float:
        """Time (s) in a control period at which the reading for this control instant, or a later one, is taken."""
        return clock.period - math.fmod(self.delay + WHOLE * clock.step, clock.period) + WHOLE * clock.step

    def drawn(self, clock: Clock) -> dict[str, Drawn]:
        """What it draws in a control period, by the name of the stream."""

        def numbers(count: int) -> Drawn:
            """For every reading that is taken."""
            if self.rate:
                return Ticking(count, 1 / self.rate, clock.period, closing=True)
            return Sampled(count, (self._offset(clock),))

        drawn: dict[str, Drawn] = {}
        if self.noise.any() or self.rate:
            drawn[self.name] = numbers(self.errors)
        if self.jitter or self.drop:
            drawn[f"{self.message} way"] = numbers(2)
        if self.drifts:
            drawn[f"{self.name} drift"] = Ticking(self.errors, DRIFT, clock.period, closing=True)
        return drawn

    def _waiting(self, clock: Clock) -> int:
        """Most readings that are on their way when a control period begins. Raises UsageError for too many."""
        slots = 1
        if self.rate:
            slots = Ticking(0, 1 / self.rate, clock.period).slots
        if slots > MOST:
            raise UsageError(
                f"sensor.{self.message}_rate={self.rate:g}: {slots} readings in a control period of"
                f" {1e3 * clock.period:g} ms; at most {MOST} are simulated"
            )
        return slots * math.ceil((self.delay + self.jitter) / clock.period - WHOLE)

    def sizes(self, clock: Clock) -> Sizes:
        """See Effect.sizes."""
        inner = self.taken + 1 + self.size
        if self.waits:
            inner += 1 + self.size + (2 + self.size) * self._waiting(clock)
        drawn = self.drawn(clock)
        return Sizes(inner, 2 * self.errors + 5, (*drawn.values(),), (*drawn,))

    def start(self, rng: np.random.Generator, clock: Clock, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Effect.start. value: what an exact sensor reads then, (size,)."""
        drift = self.first * rng.standard_normal(self.taken)
        waiting = np.tile([NEVER, 0.0, *np.zeros(self.size)], self._waiting(clock))
        reading = np.concatenate([[0.0], value])
        inner = [drift, reading]
        if self.waits:
            inner += [reading, waiting]
        numbers = [self.decay, self.gain, self.delay, self.jitter, self.drop]
        return np.concatenate(inner), np.concatenate([self.noise, self.bias, numbers])

    def measure(self, at: Readings, value_at: Callable[[Any], ca.MX]) -> tuple[ca.MX, ca.MX]:
        """Inner states after the period and what is given (size,). at: with its own inner states, parameters and draws.

        value_at: what an exact sensor reads, (size,), at a time (s) since the period began, a number or a symbol.
        """
        m = self.errors
        begins = at.t - at.clock.period
        drawn = self.drawn(at.clock)
        noise, bias, *numbers = split(at.parameters, (m, m, 1, 1, 1, 1, 1))
        decay, gain, delay, jitter, drop = numbers
        draws = named(drawn, split(at.draws, (drawing.size for drawing in drawn.values())))
        drifts = [(-NEVER, at.inner[: self.taken])]  # each with the time from which on it holds
        ticks = draws.get(f"{self.name} drift", ca.MX(0, 1))
        for tick in ca.vertsplit(ticks, 1 + m):
            before = drifts[-1][1]
            after = decay * before + gain * tick[1:]
            drifts.append((tick[0], ca.if_else(tick[0] < NEVER, after, before)))

        def slow_at(time: Any) -> Any:
            drift = drifts[0][1]
            for tick, after in drifts[1:]:
                drift = ca.if_else(tick <= time + ROUNDING, after, drift)
            if not self.drifts:
                return bias
            return bias + drift

        readings = []  # when it arrives, when it was taken, and itself
        white = [ca.MX.zeros(m)]
        if self.name in draws:
            white = ca.vertsplit(draws[self.name], m + bool(self.rate))
        way = f"{self.message} way"
        ways = [None] * len(white)
        if way in draws:
            ways = ca.vertsplit(draws[way], 2 + bool(self.rate))
        for numbers, on_way in zip(white, ways, strict=True):
            offset = self._offset(at.clock)
            lost = ca.MX(0)
            if self.rate:
                offset = numbers[0] - begins
                lost = numbers[0] >= NEVER
            time = begins + offset
            arrives = time + delay
            if on_way is not None:
                share, dropped = on_the_way(on_way[-2:], drop)
                arrives = arrives + jitter * share
                lost = ca.logic_or(lost, dropped)
            reading = self.add(value_at(offset), slow_at(time), noise * numbers[-m:])
            readings.append(ca.vertcat(ca.if_else(lost, NEVER, arrives), time, reading))
        drift = drifts[-1][1]
        latest = readings[-1][1:]
        if not self.waits:
            return ca.vertcat(drift, latest), latest[1:]
        count = len(readings)
        first = self.taken + 1 + self.size
        end = first + 1 + self.size
        base = at.inner[first:end]
        readings = [*ca.vertsplit(at.inner[end:], 2 + self.size), *readings]
        for reading in readings[:count]:  # which have arrived, if ever
            base = ca.if_else(reading[0] < NEVER, reading[1:], base)
        latest = base
        waiting = readings[count:]
        for reading in waiting:
            latest = ca.if_else(reading[0] <= at.t + ROUNDING, reading[1:], latest)
        return ca.vertcat(drift, latest, base, *waiting), latest[1:]
