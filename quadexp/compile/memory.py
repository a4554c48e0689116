"""What a law, or a layer around one, remembers from one control instant to the next: declared by name and size.

An instant is a transaction between two vectors. Functions read `now` and write `next`; the last calls of an
instant make `next` the new `now` (see control.control_step). One that is refused half-way takes `next` back to `now`,
so that Python makes it from the same memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import accumulate

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca

NOW = "memory_"  # before the names of what a function reads of the memory
NEXT = "next_"  # and writes


class Memory:
    """owner: whose it is, as users see it. sizes: how many numbers there are of each name. of_now, of_next: the arrays
    by name. now: all of them, one after another, (m,). worked: arrays that somebody works on in place, by name: these
    are of_next. pairs: now and next, as they are copied from one to the other. when: (1,), 0 where an instant has
    changed nothing; None: it may always have."""

    def __init__(
        self,
        owner: str,
        sizes: Mapping[str, int] | None = None,
        worked: Mapping[str, np.ndarray] | None = None,
        when: np.ndarray | None = None,
    ) -> None:
        self.owner = owner
        self.when = when
        self.sizes = {name: array.size for name, array in (worked or {}).items()} if sizes is None else dict(sizes)
        self.now, after = np.zeros((2, sum(self.sizes.values())))
        ends = accumulate(self.sizes.values())
        places = {name: slice(end - size, end) for (name, size), end in zip(self.sizes.items(), ends, strict=True)}
        self.of_now = {name: self.now[place] for name, place in places.items()}
        self.of_next = {name: after[place] for name, place in places.items()}
        self.pairs = [(self.now, after)]
        if worked is not None:
            self.of_next = {name: array.reshape(-1) for name, array in worked.items()}
            self.pairs = [(self.of_now[name], array) for name, array in self.of_next.items()]

    def begin(self, values: Mapping[str, np.ndarray]) -> None:
        """Remember these values by name, and of all else zeros."""
        self.now[...] = 0.0
        for name, value in values.items():
            self.of_now[name][...] = np.ravel(value)
        self.take_back()

    def commit(self) -> None:
        """The end of an instant."""
        for now, after in self.pairs:
            now[...] = after

    def take_back(self) -> None:
        """An instant is to be made again."""
        for now, after in self.pairs:
            after[...] = now

    def restore(self, values: np.ndarray) -> None:
        """Go on from `now` as it once was, (m,)."""
        self.now[...] = values
        self.take_back()


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
    read = dict(places)
    written = dict(results)
    if memory is not None:
        read |= {NOW + name: values for name, values in memory.of_now.items()}
        written |= {NEXT + name: values for name, values in memory.of_next.items()}
    return BufferedFunction(function, read, written)
