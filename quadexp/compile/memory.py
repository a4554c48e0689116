"""What a law, or a layer around one, remembers from one control instant to the next: declared by name and size.

An instant is a transaction between two vectors. Functions read `now` and write `next`; the last operations of an
instant make `next` the new `now` (see control.instant). One that is refused half-way leaves `now` as it was, so that
Python makes it from the same memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import accumulate

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca

NOW, NEXT = "memory_", "next_"  # before the names of what a function reads and writes of the memory


class Memory:
    """owner: whose it is, as users see it. sizes: how many numbers there are of each name. now, next: all of them, one
    after another, (m,)."""

    def __init__(self, owner: str, sizes: Mapping[str, int]) -> None:
        self.owner, self.sizes = owner, dict(sizes)
        self.now, self.next = np.zeros((2, sum(self.sizes.values())))
        ends = accumulate(self.sizes.values())
        places = {name: slice(end - size, end) for (name, size), end in zip(self.sizes.items(), ends, strict=True)}
        self.of_now = {name: self.now[place] for name, place in places.items()}
        self.of_next = {name: self.next[place] for name, place in places.items()}

    def begin(self, values: Mapping[str, np.ndarray]) -> None:
        """Remember these values by name, and of all else zeros."""
        self.now[...] = 0.0
        for name, value in values.items():
            self.of_now[name][...] = np.ravel(value)
        self.next[...] = self.now

    def commit(self) -> None:
        """The end of an instant."""
        self.now[...] = self.next

    def restore(self, values: np.ndarray) -> None:
        """Go on from `now` as it once was, (m,)."""
        self.now[...] = self.next[...] = values


def sizes_of(functions: Iterable[ca.Function]) -> dict[str, int]:
    """Name -> how many numbers of it the functions remember."""
    sizes = dict[str, int]()
    for function in functions:
        for name in function.name_out():
            if name.startswith(NEXT):
                sizes[name.removeprefix(NEXT)] = function.numel_out(name)
    return sizes


def connected(
    function: ca.Function,
    places: Mapping[str, np.ndarray],
    results: Mapping[str, np.ndarray],
    memory: Memory | None = None,
) -> BufferedFunction:
    """The function on the arrays that it reads and writes, so that nothing is copied.

    places: of arguments, results: of results that are no memory; what is in neither gets an array of its own."""
    read, left = dict(places), dict(results)
    if memory is not None:
        read |= {NOW + name: values for name, values in memory.of_now.items()}
        left |= {NEXT + name: values for name, values in memory.of_next.items()}
    return BufferedFunction(function, read, left)
