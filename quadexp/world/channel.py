"""A channel: one measured quantity on its way from the vehicle to the controller.

    y_i = x(s_i) + b(s_i) + sigma n_i              what is read at the time s_i;  n_i white, standard normal
    b' = a b + g n                                 every 10 ms; the drift, held in between
    arrival s_i + delay + jitter U_i, or never, with the probability `drop`;  U_i uniform in [0, 1)

The controller is told the newest reading that has arrived, until a newer one has; one that was overtaken is ignored.
With a rate, s_i = i / rate; without, every control instant t has a reading of its own, taken at t - delay. The drift is

    a = 1, g = walk sqrt(10 ms)                    random walk
    a = exp(-10 ms / T), g = S sqrt(1 - a^2)       first-order Gauss-Markov process of deviation S: S^2 exp(-|tau| / T)

White noise, drift, and jitter with losses have a random stream each, by time (streams.py): they are the same at every
control rate. Until the first reading arrives, the exact one of the start holds.

Inner states: the drift; of what is not told at once, the time at which the told reading was taken (s), the reading that
everything older has come to, with that time, and every reading on its way, the oldest first, with the times at which it
arrives and was taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.world.effect import Clock, Readings, Sizes
from quadexp.world.streams import NEVER, Drawn, Sampled, Ticking

DRIFT = 0.01  # s, for which a drift is held
ROUNDING = 1e-9  # s, by which a reading may arrive later and count as there
WHOLE = 1e-6  # of a control period or an integration step
MOST = 200  # readings in a control period


@dataclass(frozen=True, kw_only=True)
class Channel:
    """size: numbers of a reading; its errors may be fewer, as those of an attitude are.

    noise, bias: standard deviation of the white noise, and constant error, a number an error. first: standard
    deviation of the drift when a flight begins, decay, gain: a and g; likewise. rate: Hz, 0 for none. delay, jitter: s.
    add: the reading of an exact value, a slow and a random error, as symbols.
    """

    name: str
    size: int
    noise: np.ndarray
    bias: np.ndarray
    first: np.ndarray
    decay: np.ndarray
    gain: np.ndarray
    rate: float = 0.0
    delay: float = 0.0
    jitter: float = 0.0
    drop: float = 0.0
    add: Callable[[Any, Any, Any], Any] = lambda value, slow, random: (value + slow) + random

    @property
    def errors(self) -> int:
        """Numbers of an error."""
        return len(self.noise)

    @property
    def drifts(self) -> bool:
        """Whether it has a drift."""
        return bool(self.first.any() or self.gain.any())

    @property
    def waits(self) -> bool:
        """Whether a reading may not be told at the instant at which it is taken, or not be taken at every one."""
        return bool(self.rate or self.delay or self.jitter or self.drop)

    @property
    def age(self) -> float:
        """Mean age (s) of what is told at a control instant, if nothing is lost."""
        return self.delay + self.jitter / 2 + (0.5 / self.rate if self.rate else 0.0)

    def _ticks(self, numbers: int, clock: Clock) -> Drawn:
        """Numbers for every reading that is taken in a control period."""
        if self.rate:
            return Ticking(numbers, 1 / self.rate, clock.period, closing=True)
        return Sampled(numbers, (self._offset(clock),))

    def _offset(self, clock: Clock) -> float:
        """Time (s) in a control period at which the reading for a later control instant is taken."""
        return clock.period - math.fmod(self.delay + WHOLE * clock.step, clock.period) + WHOLE * clock.step

    def drawn(self, clock: Clock) -> dict[str, Drawn]:
        """What it draws in a control period, by the name of the stream."""
        drawn: dict[str, Drawn] = {}
        if self.noise.any() or self.rate:
            drawn[self.name] = self._ticks(self.errors, clock)
        if self.jitter or self.drop:
            drawn[f"{self.name} way"] = self._ticks(2, clock)
        if self.drifts:
            drawn[f"{self.name} drift"] = Ticking(self.errors, DRIFT, clock.period, closing=True)
        return drawn

    def slots(self, clock: Clock) -> int:
        """Most readings that are taken in a control period. Raises UsageError for more than MOST."""
        slots = Ticking(0, 1 / self.rate, clock.period).slots if self.rate else 1
        if slots > MOST:
            raise UsageError(
                f"sensor.{self.name}_rate={self.rate:g}: {slots} readings in a control period of"
                f" {1e3 * clock.period:g} ms; at most {MOST} are simulated"
            )
        return slots

    def _blocks(self, clock: Clock) -> int:
        """Control periods whose readings may be on their way when another one begins."""
        return math.ceil((self.delay + self.jitter) / clock.period - WHOLE)

    def sizes(self, clock: Clock) -> Sizes:
        """See Effect.sizes."""
        waiting = (2 + self.size) * self.slots(clock) * self._blocks(clock)
        inner = self.errors * self.drifts + (2 + self.size + waiting) * self.waits
        return Sizes(inner, 4 * self.errors + 3, tuple(self.drawn(clock).values()))

    def start(self, rng: np.random.Generator, clock: Clock, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Effect.start. value: what an exact sensor reads then, (size,)."""
        drift = self.first * rng.standard_normal(self.errors)
        waiting = np.tile([NEVER, 0.0, *np.zeros(self.size)], self.slots(clock) * self._blocks(clock))
        inner = [drift] * self.drifts + [np.zeros(2), value, waiting] * self.waits
        ways = [self.delay, self.jitter, self.drop]
        return np.concatenate([[], *inner]), np.concatenate([self.noise, self.bias, self.decay, self.gain, ways])

    @property
    def taken(self) -> int:
        """Which inner state is the time at which the told reading was taken."""
        return self.errors * self.drifts

    def measure(self, at: Readings, value_at: Callable[[Any], ca.MX]) -> tuple[ca.MX, ca.MX]:
        """Inner states after the period and what is told (size,). at: with its own inner states, parameters and draws.

        value_at: what an exact sensor reads, (size,), at a time (s) since the period began, a number or a symbol.
        """
        m, clock = self.errors, at.clock
        noise, bias, decay, gain, ways = ca.vertsplit(at.parameters, [0, m, 2 * m, 3 * m, 4 * m, 4 * m + 3])
        sizes = [drawn.size for drawn in self.drawn(clock).values()]
        draws = dict(zip(self.drawn(clock), ca.vertsplit(at.draws, [0, *np.cumsum(sizes).tolist()]), strict=True))
        drifts = self._drifts(at, draws, decay, gain)
        begins = at.t - clock.period

        def constant_at(time: Any) -> Any:
            """Bias and drift."""
            if not drifts:
                return bias
            drift = drifts[0][1]
            for tick, after in drifts[1:]:
                drift = ca.if_else(tick <= time + ROUNDING, after, drift)
            return bias + drift

        taken = []  # (time, way, reading), the oldest first
        white = ca.vertsplit(draws[self.name], m + bool(self.rate)) if self.name in draws else [None]
        way = ca.vertsplit(draws[f"{self.name} way"], 2 + bool(self.rate)) if self.jitter or self.drop else []
        for i, drawn in enumerate(white):
            offset = drawn[0] - begins if self.rate else self._offset(clock)
            time = drawn[0] if self.rate else begins + offset
            random = ca.MX.zeros(m) if drawn is None else noise * drawn[-m:]
            reading = self.add(value_at(offset), constant_at(time), random)
            taken.append((time, way[i][-2:] if way else None, reading))
        drift = drifts[-1][1] if drifts else at.inner[:0]
        if not self.waits:
            return drift, taken[-1][2]
        entries = [ca.vertcat(self._arrival(time, ways, on_way), time, reading) for time, on_way, reading in taken]
        return self._told(at, ca.vertcat(drift), entries)

    def _drifts(self, at: Readings, draws: dict[str, ca.MX], decay: ca.MX, gain: ca.MX) -> list[tuple[Any, ca.MX]]:
        """(time from which on it holds, drift) in the period."""
        if not self.drifts:
            return []
        drifts = [(-NEVER, at.inner[: self.errors])]
        for tick in ca.vertsplit(draws[f"{self.name} drift"], 1 + self.errors):
            drifts.append(
                (tick[0], ca.if_else(tick[0] < NEVER, decay * drifts[-1][1] + gain * tick[1:], drifts[-1][1]))
            )
        return drifts

    def _arrival(self, time: ca.MX, ways: ca.MX, drawn: ca.MX | None) -> ca.MX:
        """When a reading arrives (s), NEVER where it is lost, or none was taken."""
        arrives, lost = time + ways[0], time >= NEVER
        if drawn is not None:
            uniform = (1 + ca.erf(drawn / math.sqrt(2))) / 2
            arrives, lost = arrives + ways[1] * uniform[0], ca.logic_or(lost, uniform[1] < ways[2])
        return ca.if_else(lost, NEVER, arrives)

    def _told(self, at: Readings, drift: ca.MX, entries: Sequence[ca.MX]) -> tuple[ca.MX, ca.MX]:
        """Inner states after the period and what is told, with the readings that were taken in it."""
        first, slots, size = self.taken + 1, len(entries), 1 + self.size
        base = at.inner[first : first + size]
        entries = [*ca.vertsplit(at.inner[first + size :], 1 + size), *entries]
        for entry in entries[:slots]:  # which have arrived, if ever
            base = ca.if_else(entry[0] < NEVER, entry[1:], base)
        newest, waiting = base, entries[slots:]
        for entry in waiting:
            newest = ca.if_else(entry[0] <= at.t + ROUNDING, entry[1:], newest)
        return ca.vertcat(drift, newest[0], base, *waiting), newest[1:]
