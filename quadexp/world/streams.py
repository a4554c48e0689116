"""Random numbers of a flight: each part's from a stream of its own, and each a function of time.

A part's stream comes from the seed of the flight's generator and the part's name. So every part meets the same numbers
whatever else is switched on. Numbers belong to ticks i T of a clock that starts with the flight, not to control periods
or integration steps. So every controller meets the same numbers at every rate:

    Sampled   what is drawn at an instant t has the numbers of the tick floor(t / T)
    Ticking   what goes on at every tick has the numbers of each tick in the control period
    Held      white noise of density 1 is w(t) = n_i / sqrt(T) for i T <= t < (i + 1) T; an interval h has sqrt(h) times
              its mean there, which is standard normal where the interval is one of whole ticks

Most ticks of `Sampled` are not needed: number i is the i-th of SplitMix64 (Steele, Lea and Flood 2014), which needs
none before it, made normal after Box and Muller (1958).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca

WORDS = 4  # of 32 bits, that name a stream
TICK = 5e-4  # s
EARLY = 1e-6  # of a tick, by which a time may come before it and belong to it
NEVER = 1e9  # s
BLOCK = 128  # control periods that are drawn at once


class Silence(np.random.Generator):
    """A generator whose normal numbers, and those of every part's stream, are zero: nothing differs from its mean."""

    def __init__(self) -> None:
        super().__init__(np.random.PCG64(0))

    def standard_normal(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        if size is None:
            return 0.0
        return np.zeros(size, dtype)


def on_the_way(numbers: Any, drop: Any) -> tuple[Any, Any]:
    """The share of a jitter, uniform in [0, 1), and whether something is lost, with the probability `drop`, of two
    standard normal numbers. Zeros, which are Silence's: half of the jitter, and nothing is lost."""
    uniform = (1 + ca.erf(numbers / math.sqrt(2))) / 2
    return uniform[0], ca.logic_and(uniform[1] < drop, numbers[1] != 0)


def part_stream(rng: np.random.Generator, part: str) -> np.random.Generator:
    """The stream of a part, a new one at every call; rng itself is left as it is."""
    if isinstance(rng, Silence):
        return rng
    seed: Any = rng.bit_generator.seed_seq
    digest = hashlib.sha256(part.encode()).digest()
    words = np.frombuffer(digest[: 4 * WORDS], "<u4")
    key = (*seed.spawn_key, *words.tolist())
    own = np.random.SeedSequence(seed.entropy, spawn_key=key, pool_size=seed.pool_size)
    return np.random.default_rng(own)


@dataclass(frozen=True)
class Sampled:
    """`numbers` standard normal ones at each of some instants (s, since the control period began)."""

    numbers: int
    instants: tuple[float, ...]
    tick: float = TICK

    @property
    def size(self) -> int:
        """Numbers of a control period: instant by instant."""
        return self.numbers * len(self.instants)

    def begin(self, rng: np.random.Generator) -> Any:
        """(when control periods begin (k,), when the last one ends) -> their numbers (k, size), period after period."""
        key = rng.integers(2**64, dtype=np.uint64)

        def take(begins: np.ndarray, end: float) -> np.ndarray:
            times = begins[:, None] + self.instants
            ticks = np.floor(times / self.tick + EARLY).astype(np.uint64)
            return _split_mix(key, ticks, self.numbers).reshape(len(begins), -1)

        return take


@dataclass(frozen=True)
class Ticking:
    """`numbers` standard normal ones at every tick (s) after the start of the flight."""

    numbers: int
    tick: float
    period: float  # s, of control
    closing: bool = False  # whether a tick at the end of a period belongs to it, and not to the next one

    @property
    def slots(self) -> int:
        """Largest number of ticks in a control period."""
        return math.ceil(self.period / self.tick - EARLY)

    @property
    def size(self) -> int:
        """Numbers of a control period: slot by slot the time of its tick (s), NEVER where there is none, and the
        tick's numbers."""
        return (1 + self.numbers) * self.slots

    def begin(self, rng: np.random.Generator) -> Any:
        """See Sampled.begin."""

        def take(begins: np.ndarray, end: float) -> np.ndarray:
            edges = np.append(begins, end) / self.tick
            first = np.ceil(edges - EARLY).clip(1)
            if self.closing:
                first = np.floor(edges + EARLY) + 1
            ticks = first[:-1, None] + np.arange(self.slots)
            there = ticks < first[1:, None]
            numbers_at = np.zeros((*ticks.shape, 1 + self.numbers))
            numbers_at[..., 0] = np.where(there, self.tick * ticks, NEVER)
            numbers_at[there, 1:] = rng.standard_normal((there.sum(), self.numbers))
            return numbers_at.reshape(len(begins), -1)

        return take


@dataclass(frozen=True)
class Held:
    """`numbers` independent white noises over intervals of the control period. bounds: of these, (k + 1,), s."""

    numbers: int
    bounds: tuple[float, ...]
    tick: float = TICK

    @property
    def size(self) -> int:
        """Numbers of a control period: interval by interval."""
        return self.numbers * (len(self.bounds) - 1)

    def begin(self, rng: np.random.Generator) -> Any:
        """See Sampled.begin."""
        rows = np.empty((0, self.numbers))
        first = 0  # the tick of the first row

        def take(begins: np.ndarray, end: float) -> np.ndarray:
            nonlocal first, rows
            edges = np.append(begins[:, None] + self.bounds[:-1], end) / self.tick
            whole = np.rint(edges)
            edges = np.where(np.abs(edges - whole) < EARLY, whole, edges)
            more = math.ceil(edges[-1]) - first - len(rows)
            new = rng.standard_normal((more, self.numbers))
            if not len(rows) and len(edges) == more + 1 and np.array_equal(edges, whole):  # an interval is a tick
                first += more
                return new.reshape(len(begins), -1)
            rows = np.concatenate([rows, new])
            path = np.concatenate([np.zeros((1, self.numbers)), rows]).cumsum(axis=0)
            corner = np.floor(edges).astype(int)
            beyond = edges - corner
            corner -= first
            row = rows[np.minimum(corner, len(rows) - 1)]
            path = path[corner] + beyond[:, None] * row
            first += corner[-1]
            rows = rows[corner[-1] :]
            lengths = np.diff(edges)[:, None]
            noise = np.diff(path, axis=0) / np.sqrt(lengths)
            return noise.reshape(len(begins), -1)

        return take


Drawn = Sampled | Ticking | Held


class Streams:
    """The numbers of a flight's control periods, in the order of the parts: `block` has them from period `first` on.

    parts: what is drawn, and the stream of each. period: s, of control. duration: s, of the flight, 0 where it may be
    any: no more is drawn at once than is left of it.
    """

    def __init__(
        self, parts: Sequence[tuple[np.random.Generator, Drawn]], period: float, duration: float = 0.0
    ) -> None:
        self._period = period
        self._takers = [drawn.begin(rng) for rng, drawn in parts]
        self._periods = round(duration / period)
        self.size = sum(drawn.size for _, drawn in parts)
        self._kept = np.empty((BLOCK, self.size))
        self.block = self._kept[:0]
        self.first = 0
        self.taken = 0  # periods

    @property
    def end(self) -> int:
        """The first period that is not in the block."""
        return self.first + len(self.block)

    def draw(self) -> None:
        """The next block."""
        self.first = self.end
        size = BLOCK
        if self.first < self._periods:
            size = min(BLOCK, self._periods - self.first)
        times = self._period * np.arange(self.first, self.first + size + 1)
        self.block = self._kept[:size]  # new memory costs more than a draw
        column = 0
        for take in self._takers:
            numbers = take(times[:-1], times[-1])
            end = column + numbers.shape[1]
            self.block[:, column:end] = numbers
            column = end

    def standard_normal(self, out: np.ndarray) -> None:
        """As Generator.standard_normal: the numbers of the next period."""
        if self.taken == self.end:
            self.draw()
        out.ravel()[:] = self.block[self.taken - self.first]
        self.taken += 1


def _split_mix(key: np.uint64, ticks: np.ndarray, numbers: int) -> np.ndarray:
    """Standard normal numbers (.., numbers) of ticks (..), of the sequence that begins at a key."""
    pairs = (numbers + 1) // 2
    place = ticks[..., None] * np.uint64(2 * pairs) + np.arange(1, 2 * pairs + 1, dtype=np.uint64)
    z: Any = key + place * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ z >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ z >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
    bits = (z ^ z >> np.uint64(31)) >> np.uint64(11)
    uniform = (bits + 0.5) * 2.0**-53
    radius = np.sqrt(-2 * np.log(uniform[..., :pairs]))
    angle = 2 * np.pi * uniform[..., pairs:]
    normal = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    return normal[..., :numbers]
