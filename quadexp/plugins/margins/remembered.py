"""Which numbers a control instant remembers, and which of its calls they reach.

What is read and written is known by the addresses of the numbers: calls that share one are connected.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from quadexp.control.control_step import Call, ControlStep


def _touched(o: Call, targets: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """What a call reads and writes; one in Python may read all targets. Nothing of the MPC's step."""
    if o.function is not None:
        return [*o.function.arguments.values()], [*o.function.results.values()]
    if o.kind in ("plan", "python"):
        return (targets if o.kind == "python" else []), []
    sources = [o.source, o.other]
    to = [o.to]
    if o.kind == "window":
        sources = []
        to = [o.to, o.other]
    elif o.kind == "commit":  # of a memory that is worked on in place what is read is its source
        sources = [o.source]
        to = [o.to, o.source]
    return [array for array in sources if array is not None], [array for array in to if array is not None]


def calls_to_command(calls: list[Call], instant: ControlStep) -> list[Call]:
    """The calls from which a number gets to the command, at this instant or later; not what only watches."""
    targets = [o.to for o in calls if o.to is not None]
    needed = _places([instant.command])
    kept = set[int]()
    more = True
    while more:
        more = False
        for i, o in enumerate(calls):
            reads, writes = _touched(o, targets)
            if i not in kept and (o.kind in ("plan", "python") or _places(writes) & needed):
                planned = instant.plan.mpc.step.arguments.values() if o.kind == "plan" else []
                needed |= _places([*reads, *planned, *([] if o.when is None else [o.when])])
                kept.add(i)
                more = True
    return [o for i, o in enumerate(calls) if i in kept]


class Remembered:
    """What is remembered from instant to instant, by what gets to the command. values: all of it, (m,). planned: the
    MPC's solution."""

    def __init__(self, instant: ControlStep, calls: list[Call]) -> None:
        used = _places(array for o in calls for array in _touched(o, [])[0])
        self._read = used
        plan = instant.plan
        self.planned = [] if plan is None else [plan.mpc.memory]
        self._kept = [
            part
            for part in instant.memory
            if part not in self.planned and _places([part.now, *part.of_next.values()]) & used
        ]

    def reads(self, array: np.ndarray) -> bool:
        """Whether a call reads the array."""
        return bool(_places([array]) & self._read)

    @property
    def values(self) -> np.ndarray:
        return np.concatenate([np.zeros(0), *(part.now for part in self._kept)])

    @values.setter
    def values(self, values: np.ndarray) -> None:
        first = 0
        for part in self._kept:
            part.restore(values[first : first + part.now.size])
            first += part.now.size


def _places(arrays: Iterable[np.ndarray]) -> set[int]:
    """Addresses of all numbers of some arrays."""
    addresses = set[int]()
    for array in arrays:
        places = np.array([array.ctypes.data])
        for count, stride in zip(array.shape, array.strides, strict=True):
            places = np.add.outer(places, stride * np.arange(count)).ravel()
        addresses.update(places.tolist())
    return addresses
