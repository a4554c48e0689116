"""A control instant as operations on fixed arrays, in order: what C does of it, without Python (experiment/flight.c).

A controller that can be flown so has a method `instant(told)`; what is around it asks the one inside, and adds its own
operations before and behind. An operation reads and writes the very arrays that the Python loop works on, so that the
one may take over from the other at any instant. Up to the plan, or the law's command, nothing is lost that a later
operation may refuse: what is to be remembered is moved by `Move`, which is taken back where the instant is left to
Python. Behind it nothing refuses.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from quadexp.compile.backend import BufferedFunction

KINDS = (
    "call", "copy", "move", "row", "window", "square", "divide", "mean", "mix", "finite", "below", "near", "plan",
)  # fmt: skip


class Operation(NamedTuple):
    """to, source, other: arrays; numbers as many as `to` has. factor: a number. function: that is called. every: at
    which instants, one of so many.

    call    function, on its arguments and results
    copy    to = source
    move    the same, for what is remembered from instant to instant
    row     to = source[k], k the instant
    window  states of the reference over the horizon to `to`, inputs to `other`
    square  to = factor source^2
    divide  to = source / other[0]
    mean    to = (source + other) / 2
    mix     to = factor source + (1 - factor) other
    finite  Python's instant where a number of source is not
    below   the same where source[0] > factor
    near    the same where positions at the beginning of source and other are further apart than factor
    plan    the MPC's step on its own arrays
    """

    kind: str
    to: np.ndarray | None = None
    source: np.ndarray | None = None
    other: np.ndarray | None = None
    factor: float = 0.0
    function: BufferedFunction | None = None
    every: int = 1


class Told(NamedTuple):
    """Where a controller finds what it is told: state (13,), specific force (3,), rotor speeds (n,), None where they
    are not measured. Of the reference at the instants: position (k, 5, 3), yaw (k, 3)."""

    state: np.ndarray
    force: np.ndarray
    speed: np.ndarray | None
    position: np.ndarray
    yaw: np.ndarray


class Instant(NamedTuple):
    """operations: in their order. command: where they leave it, (n,). held: number of rotors at a limit, of a law.
    logged: what `Controller.log` gives, in its order. mpc: that makes the plan. ready: whether all this holds at the
    next instant. resumed: told the instant at which Python goes on, and the record of the last step."""

    operations: list[Operation]
    command: np.ndarray
    held: np.ndarray | None = None
    logged: tuple[np.ndarray, ...] = ()
    mpc: Any = None
    ready: tuple[Callable[[], bool], ...] = ()
    resumed: tuple[Callable[[int, Any], None], ...] = ()


def call(function: BufferedFunction) -> Operation:
    return Operation("call", function=function)


def copy(to: np.ndarray, source: np.ndarray) -> Operation:
    return Operation("copy", to, source)


def move(to: np.ndarray, source: np.ndarray) -> Operation:
    return Operation("move", to, source)


def in_operations(controller: Any) -> bool:
    """Whether a controller is of this program, and its class, which may step in another way than its parent, says what
    its own instant is."""
    if not type(controller).__module__.startswith("quadexp.") or not hasattr(controller, "instant"):
        return False
    steps, knows = (next(c for c in type(controller).__mro__ if name in vars(c)) for name in ("step", "instant"))
    return issubclass(knows, steps)


def instant_of(controller: Any, told: Told) -> Instant | None:
    """The instant of a controller; None where Python has to fly it."""
    made: Instant | None = controller.instant(told) if in_operations(controller) else None
    return made
