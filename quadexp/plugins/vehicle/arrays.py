"""The arrays that a controller's calls work on, as places in four C arrays.

    numbers   what may be changed in flight: parameters of the model of the air, weights, limits, an observer's settings
    ram       what a call writes
    sums      what is summed up over a flight, in double precision always
    rom       all else

Arrays of Python that overlap become one block, so that aliases stay aliases. A block keeps its bytes in the order of
the arrays that were found first, so two exports of one controller are the same.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import Flag, auto

import numpy as np

SIZE = 8  # bytes of a number in Python


class Use(Flag):
    """What is done with an array. WRITTEN: by calls, beside being read. CLEARED: what it holds now is not needed.
    CHANGED: by a user, where no call writes it. SUMMED: over a flight."""

    READ = 0
    WRITTEN = auto()
    CLEARED = auto()
    CHANGED = auto()
    SUMMED = auto()
    WORK = WRITTEN | CLEARED


@dataclass
class Block:
    """Memory of overlapping arrays: addresses first .. end - 1. place: its array in C, and where it begins there."""

    first: int
    end: int
    order: int
    use: Use
    place: tuple[str, int] = ("", 0)

    @property
    def count(self) -> int:
        """Of its numbers."""
        return (self.end - self.first) // SIZE

    def values(self) -> np.ndarray:
        """Its numbers as they are; zeros of what is written before it is read."""
        if Use.CLEARED in self.use:
            return np.zeros(self.count)
        return np.array((ctypes.c_double * self.count).from_address(self.first))


def span(array: np.ndarray) -> tuple[int, int]:
    """Addresses of the first number and behind the last one."""
    steps = zip(array.shape, array.strides, strict=True)
    length = sum((size - 1) * stride for size, stride in steps) + SIZE
    return array.ctypes.data, array.ctypes.data + length


@dataclass
class Arrays:
    """Filled by `add`, then placed by `lay_out`; `at` gives a place as C."""

    found: list[Block] = field(default_factory=list)
    kept: list[np.ndarray] = field(default_factory=list)  # alive as long as their addresses
    blocks: list[Block] = field(default_factory=list)
    shared: dict[int, np.ndarray] = field(default_factory=dict)  # address of an array -> whose memory it shares
    lent: dict[int, tuple[str, int]] = field(default_factory=dict)  # address of an array -> its place elsewhere

    def add(self, array: np.ndarray | None, use: Use = Use.READ) -> None:
        """An array of calls."""
        if array is None or not array.size:
            return
        if array.dtype != float:
            raise ValueError(f"an array of {array.dtype} is no memory of a controller")
        self.kept.append(array)
        first, end = span(array)
        self.found.append(Block(first, end, len(self.found), use))

    def add_all(self, arrays: Iterable[np.ndarray], use: Use) -> None:
        """Several."""
        for array in arrays:
            self.add(array, use)

    def lay_out(self) -> None:
        """Join what overlaps, and give each block its place; in ram what begins with zeros is last."""
        self.blocks = []
        for part in sorted(self.found, key=lambda block: (block.first, block.end)):
            last = self.blocks[-1] if self.blocks else None
            if last is None or part.first >= last.end:
                self.blocks.append(replace(part))
                continue
            last.end = max(last.end, part.end)
            last.order = min(last.order, part.order)
            last.use |= part.use
        ends = {"numbers": 0, "ram": 0, "sums": 0, "rom": 0}
        for block in sorted(self.blocks, key=self._rank):
            name = self._array_of(block)
            block.place = name, ends[name]
            ends[name] += block.count

    def _array_of(self, block: Block) -> str:
        for use, name in ((Use.SUMMED, "sums"), (Use.WRITTEN, "ram"), (Use.CHANGED, "numbers")):
            if use in block.use:
                return name
        return "rom"

    def _rank(self, block: Block) -> tuple[bool, int]:
        return not block.values().any(), block.order

    def contents(self, name: str) -> np.ndarray:
        """Of an array of C, as a flight begins."""
        inside = sorted((block for block in self.blocks if block.place[0] == name), key=lambda block: block.place[1])
        return np.concatenate([np.zeros(0), *(block.values() for block in inside)])

    def place(self, array: np.ndarray) -> tuple[str, int]:
        """The array of C, and where in it this one begins."""
        if array.ctypes.data in self.lent:
            return self.lent[array.ctypes.data]
        first, end = span(self.shared.get(array.ctypes.data, array))
        block = next(block for block in self.blocks if block.first <= first and end <= block.end)
        name, begins = block.place
        return name, begins + (first - block.first) // SIZE

    def at(self, array: np.ndarray | None) -> str:
        """A place as C; 0 for none."""
        if array is None or not array.size:
            return "0"
        name, begins = self.place(array)
        return f"(void *)(sums + {begins})" if name == "sums" else f"{name} + {begins}"
