"""Hypotheses about what is wrong with a flight, each as the repair that would undo it.

A repair maps windows to windows. The one under which the relations of quadexp/log/check/windows.py hold names the
fault. Frames: world ENU from NED is (y, x, -z), body FLU from FRD is (x, -y, -z); both are their own inverse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import permutations, product
from typing import Any

import numpy as np

from quadexp.log.check.windows import Windows, multiply
from quadexp.physics.vehicle import GRAVITY

NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])  # world, NED to ENU
FRD = np.diag([1, -1, -1])  # body, FRD to FLU
Q_NED = np.array([0, 1, 1, 0]) / np.sqrt(2)  # the rotation NED
Q_FRD = np.array([0, 1.0, 0, 0])
COLUMNS = {"p": "p_*", "v": "v_*", "w": "w_*", "f": "acc_*", "q": "q_*", "t": "t"}
LENGTHS = {"cm": 100.0, "mm": 1000.0, "feet": 1 / 0.3048}
SPEEDS = {"cm/s": 100.0, "mm/s": 1000.0, "km/h": 3.6, "feet/s": 1 / 0.3048, "knots": 1 / 0.514444}


@dataclass(frozen=True)
class Repair:
    """name: of the fault it undoes. streams: what it changes, letters of Windows. text: what the data fit, one phrase.

    cost: how much it claims; of two repairs that explain a flight alike, the one that claims less is taken. severity,
    advice: of the finding.
    """

    name: str
    streams: str
    text: str
    apply: Callable[[Windows], Windows]
    cost: float = 1.0
    severity: str = "blocking"
    advice: str = "state it in the mapping of the import"

    @property
    def where(self) -> str:
        return ", ".join(COLUMNS[stream] for stream in self.streams)


def _turned(streams: str, matrix: np.ndarray) -> Callable[[Windows], Windows]:
    def apply(windows: Windows) -> Windows:
        values = {name: getattr(windows, name) for name in streams}
        return windows.having(**{name: x @ matrix.T for name, x in values.items() if x is not None})

    return apply


def _scaled(streams: str, factor: float) -> Callable[[Windows], Windows]:
    def apply(windows: Windows) -> Windows:
        values = {name: getattr(windows, name) for name in streams}
        return windows.having(**{name: x * factor for name, x in values.items() if x is not None})

    return apply


def _attitude(function: Callable[[np.ndarray], np.ndarray]) -> Callable[[Windows], Windows]:
    return lambda windows: windows.having(q=function(windows.of("q")))


def _times(factors: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    return lambda q: q * factors


def _chain(*functions: Callable[[Windows], Windows]) -> Callable[[Windows], Windows]:
    def apply(windows: Windows) -> Windows:
        for function in functions:
            windows = function(windows)
        return windows

    return apply


def _to_world(name: str) -> Callable[[Windows], Windows]:
    return lambda one: one.having(**{name: np.einsum("nlij,nlj->nli", one.of("rotation"), one.of(name))})


def _to_body(name: str) -> Callable[[Windows], Windows]:
    return lambda one: one.having(**{name: np.einsum("nlji,nlj->nli", one.of("rotation"), one.of(name))})


def _with_gravity(sign: float) -> Callable[[Windows], Windows]:
    def apply(one: Windows) -> Windows:
        return one.having(f=one.of("f") + sign * GRAVITY * one.of("rotation")[..., 2, :])

    return apply


def conjugate(q: np.ndarray) -> np.ndarray:
    return q * np.array([1, -1, -1, -1])


def scalar_last(q: np.ndarray) -> np.ndarray:
    """The columns w, x, y, z hold x, y, z, w."""
    return q[..., [3, 0, 1, 2]]


@cache
def signed_permutations() -> tuple[tuple[np.ndarray, str, str, float], ...]:
    """The 47 ways to name and sign three axes wrongly: matrix, fault, phrase, cost."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if (matrix == np.eye(3)).all():
                continue
            flipped = [axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0]
            terms = ", ".join(("-" if s < 0 else "") + "xyz"[k] for k, s in zip(order, signs, strict=True))
            swapped = sum(order[i] != i for i in range(3))
            if not swapped:
                fault, text = "sign_flip", f"the sign of {' and '.join(flipped)} is reversed"
            else:
                fault, text = "axis_swap", f"x, y, z are ({terms}) of the columns"
            found.append((matrix, fault, text, 1.0 + 0.5 * (len(flipped) - 1 if not swapped else len(flipped) + 1)))
    return tuple(found)


@cache
def repairs(present: frozenset[str]) -> tuple[Repair, ...]:
    """Every hypothesis about the streams at hand (letters of Windows)."""
    found: list[Repair] = []

    def add(needs: str, *arguments: Any, **options: Any) -> None:
        if set(needs) <= present:
            found.append(Repair(*arguments, **options))

    for name in ("v", "p", "pv", "w", "f"):
        for matrix, fault, text, cost in signed_permutations():
            if name in ("v", "p", "pv") and (matrix == NED).all():
                fault, text, cost = "ned_not_converted", "they are in NED (x north, y east, z down), not ENU", 1.2
            elif name in ("w", "f") and (matrix == FRD).all():
                fault, text, cost = "frd_not_converted", "they are in FRD (y right, z down), not FLU", 1.2
            elif name == "f" and (matrix == -np.eye(3)).all():
                text, cost = "the sign of all axes is reversed (gravity, not specific force)", 1.1
            elif (matrix == np.diag([1, 1, -1])).all() and name in ("p", "pv"):
                fault, text = "z_down", "z points down, not up"
            cost = cost + 0.2 * (name == "pv")
            add(name, fault, name, text, _turned(name, matrix), cost=cost)
    for unit, factor in SPEEDS.items():
        add("v", "units", "v", f"{unit}, not m/s", _scaled("v", 1 / factor))
    for unit, factor in LENGTHS.items():
        add("p", "units", "p", f"{unit}, not m", _scaled("p", 1 / factor))
        add("pv", "units", "pv", f"{unit} and {unit}/s, not m and m/s", _scaled("pv", 1 / factor), cost=1.2)
    add("w", "units", "w", "degrees/s, not rad/s", _scaled("w", np.pi / 180))
    add("f", "units", "f", "g, not m/s^2", _scaled("f", GRAVITY))
    add("f", "units", "f", "milli-g, not m/s^2", _scaled("f", GRAVITY / 1000))
    if "q" in present:
        body = "body frame, not world"
        add("v", "frame_velocity", "v", body, _to_world("v"))
        add(
            "v", "frame_velocity", "v", "body frame FRD, not world", _chain(_turned("v", FRD), _to_world("v")), cost=1.3
        )
        add("w", "frame_rate", "w", "world frame, not body", _to_body("w"))
        add("f", "frame_acceleration", "f", "world frame, not body", _to_body("f"))
        add("f", "gravity_removed", "f", "gravity is taken out: not specific force", _with_gravity(1.0), cost=1.1)
        coordinate = _chain(_to_body("f"), _with_gravity(1.0))
        add("f", "gravity_removed", "f", "coordinate acceleration in the world frame", coordinate, cost=1.4)
        add("q", "quaternion_conjugate", "q", "world to body, not body to world", _attitude(conjugate))
        add("q", "quaternion_order", "q", "the scalar is last, not first", _attitude(scalar_last))
        both = _attitude(lambda q: conjugate(scalar_last(q)))
        add("q", "quaternion_order", "q", "the scalar is last, and world to body", both, cost=1.5)
        first = _attitude(lambda q: q[..., [1, 2, 3, 0]])
        add("q", "quaternion_order", "q", "the columns are rotated by one: w, x, y, z hold z, w, x, y", first, cost=1.6)
        to_ned = _attitude(lambda q: multiply(Q_NED, q))
        to_frd = _attitude(lambda q: multiply(q, Q_FRD))
        ned = _chain(to_ned, to_frd)
        add("q", "ned_not_converted", "q", "FRD to NED, not FLU to ENU", ned, cost=1.2)
        add("q", "ned_not_converted", "q", "the world is NED, not ENU", to_ned, cost=1.3)
        add("q", "frd_not_converted", "q", "the body is FRD, not FLU", to_frd, cost=1.3)
        for k, axis in enumerate("xyz"):
            sign = np.ones(4)
            sign[k + 1] = -1
            flip = _attitude(_times(sign))
            add("q", "sign_flip", "q", f"the sign of q_{axis} is reversed", flip, cost=1.4)
        motion = "".join(name for name in "pv" if name in present)
        sensors = "".join(name for name in "wf" if name in present)
        every = _chain(_turned(motion, NED), ned, _turned(sensors, FRD))
        add(motion, "ned_not_converted", f"{motion}q{sensors}", "all is in NED and FRD", every, cost=1.4)
        world = _chain(_turned(motion, NED), to_ned)
        add(motion, "ned_not_converted", f"{motion}q", "the world is NED, not ENU", world, cost=1.4)
        frd = _chain(to_frd, _turned(sensors, FRD))
        if sensors:
            add(sensors, "frd_not_converted", f"q{sensors}", "the body is FRD, not FLU", frd, cost=1.3)
    if {"w", "f"} <= present:
        for matrix, fault, text, cost in signed_permutations():
            if (matrix == FRD).all():
                fault, text, cost = "frd_not_converted", "they are in FRD (y right, z down), not FLU", 1.1
            add("wf", fault, "wf", text, _turned("wf", matrix), cost=cost + 0.3)
    return tuple(found)


def clock_repair(gain: float) -> Repair:
    """The clock counts `gain` seconds in one: every rate of change comes out too small by it."""
    text = {1e3: "milliseconds, not s", 1e6: "microseconds, not s", 1e9: "nanoseconds, not s"}
    unit = next((words for factor, words in text.items() if abs(gain / factor - 1) < 0.05), None)
    words = unit or f"the clock runs {gain:.4g} times as fast as the motion"
    return Repair("units" if unit else "clock_scale", "t", words, lambda one: one.having(t=one.t / gain))


def scale_repairs(gain: float, streams: str) -> tuple[Repair, ...]:
    """One stream of two is too large by a factor that no unit has; `gain` is that of the first over the second."""
    first, second = streams[0], streams[1]
    found = [Repair("scale", first, f"{gain:.4g} times too large", _scaled(first, 1 / gain), 1.3)]
    if second == "p":
        found.append(Repair("scale", second, f"{1 / gain:.4g} times too large", _scaled(second, gain), 1.4))
    return tuple(found)
