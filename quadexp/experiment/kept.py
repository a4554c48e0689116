"""What is costly is made once per thread and kept: a worker flies many cells with few controllers.

What is kept has a memory, and buffers that compiled code works on, so its thread is its only owner; a flight begins by
resetting it.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

from quadexp.experiment.identity import digest

T = TypeVar("T")
KEPT = 64  # things kept at most, the one not used for longest goes: a sweep over plants makes a plant a cell


class _Kept(threading.local):
    def __init__(self) -> None:
        self.things: dict[str, Any] = {}


_kept = _Kept()


def keep(record: Any, make: Callable[[], T]) -> T:
    """What this thread made before of an equal record, else a new one."""
    key, things = digest(record), _kept.things
    made = things.pop(key) if key in things else make()
    while len(things) >= KEPT:
        del things[next(iter(things))]
    things[key] = made
    return made


@contextlib.contextmanager
def unshared() -> Iterator[None]:
    """What is built inside is new, and nobody else gets it: parts have states, such as what a controller identified."""
    kept, _kept.things = _kept.things, {}
    try:
        yield
    finally:
        _kept.things = kept
