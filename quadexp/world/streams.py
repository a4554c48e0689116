"""Random numbers of a flight by part, each part's from a stream of its own.

A part's stream comes from the seed of the flight's generator and the part's name. So every part meets the same numbers
whatever else is switched on, and so does every controller.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

WORDS = 4  # of 32 bits, that name a stream


def part_stream(rng: np.random.Generator, part: str) -> np.random.Generator:
    """The stream of a part, a new one at every call; rng itself is left as it is."""
    seed: Any = rng.bit_generator.seed_seq
    words = np.frombuffer(hashlib.sha256(part.encode()).digest()[: 4 * WORDS], "<u4")
    key = (*seed.spawn_key, *(int(word) for word in words))
    return np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=key, pool_size=seed.pool_size))


class Share(NamedTuple):
    """What a part takes of its stream in a control period: noise (steps of it), then draws, once."""

    rng: np.random.Generator
    noise: int
    draws: int = 0


class Streams:
    """Standard normal numbers of a control period: noise (steps, d) with a column a number, then all draws."""

    def __init__(self, shares: Sequence[Share], steps: int) -> None:
        self._shares, self._steps = shares, steps
        self._kept: dict[int, list[np.ndarray]] = {}
        self.noise_size = steps * sum(share.noise for share in shares)
        self.size = self.noise_size + sum(share.draws for share in shares)

    def take(self, periods: int) -> np.ndarray:
        """The numbers of the next periods, (periods, size), until the next call; one by one they are the same."""
        found, *blocks = self._memory(periods)
        if len(blocks) == 1 and not self._shares[0].draws:
            self._shares[0].rng.standard_normal(out=found)
            return found
        noise = found[:, : self.noise_size].reshape(periods, self._steps, -1) if self.noise_size else None
        sole = sum(share.noise > 0 for share in self._shares) == 1  # then its numbers are in their order already
        row, draw = 0, self.noise_size
        for share, block in zip(self._shares, blocks, strict=True):
            share.rng.standard_normal(out=block)
            found[:, draw : draw + share.draws] = block[:, : share.draws]
            if share.noise and sole:
                found[:, : self.noise_size] = block[:, share.draws :]
            elif noise is not None and share.noise:
                noise[:, :, row : row + share.noise] = block[:, share.draws :].reshape(periods, self._steps, -1)
            row, draw = row + share.noise, draw + share.draws
        return found

    def _memory(self, periods: int) -> list[np.ndarray]:
        """Arrays of `take`: the numbers of all parts together, and those of each. New memory costs more than a draw."""
        if periods not in self._kept:
            sizes = [self.size, *(self._steps * share.noise + share.draws for share in self._shares)]
            self._kept = {periods: [np.empty((periods, size)) for size in sizes]}
        return self._kept[periods]

    def standard_normal(self, out: np.ndarray) -> None:
        """As Generator.standard_normal: the numbers of the next period."""
        out.ravel()[:] = self.take(1)[0]

    @property
    def state(self) -> list[Any]:
        """Where all streams are."""
        return [share.rng.bit_generator.state for share in self._shares]

    @state.setter
    def state(self, states: list[Any]) -> None:
        for share, state in zip(self._shares, states, strict=True):
            share.rng.bit_generator.state = state
