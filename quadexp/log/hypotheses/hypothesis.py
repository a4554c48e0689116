"""What may be wrong with a log: each hypothesis as the transformation that mends it and as a correction of the mapping.

Frames: world ENU from NED is (y, x, -z), body FLU from FRD is (x, -y, -z); both are their own inverse.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from itertools import permutations, product
from typing import Any

import numpy as np

from quadexp.log.hypotheses.windows import Windows, multiply
from quadexp.log.units import UNITS, axes_matrix, axes_words
from quadexp.messages import yaml
from quadexp.physics.vehicle import GRAVITY

NED = axes_matrix("world", "NED", "")
FRD = axes_matrix("body", "FRD", "")
COLUMNS = {"p": "p_*", "v": "v_*", "w": "w_*", "f": "acc_*", "q": "q_*", "t": "t"}
KEYS = {"p": "position", "v": "velocity", "w": "rate", "f": "acceleration", "q": "attitude", "t": "time"}
SPEEDS = ("cm/s", "mm/s", "km/h", "ft/s", "kn")  # units that a log may be in and its mapping not say
LENGTHS = ("cm", "mm", "ft")

Correction = dict[str, Any]  # lines of a mapping, such as {"world": "NED", "rate": {"unit": "deg/s"}}
Change = Callable[[Windows], Windows]


@dataclass(frozen=True)
class Hypothesis:
    """name: of the fault. streams: what it changes, letters of Windows. text: what the data are, one phrase. apply: how
    the streams are put right. correction: lines of the mapping that do so in an import.

    cost: how much it claims; of two that explain a flight alike, the one that claims less is taken. severity, options
    (of the import, that do the same): of the finding.
    """

    name: str
    streams: str
    text: str
    apply: Change
    correction: Correction = field(default_factory=dict)
    cost: float = 1.0
    severity: str = "blocking"
    options: str = ""

    @property
    def where(self) -> str:
        return ", ".join(COLUMNS[stream] for stream in self.streams)

    @property
    def advice(self) -> str:
        """The lines of the mapping, one line of text."""
        lines = ", ".join(f"`{flow({key: value})[1:-1]}`" for key, value in self.correction.items())
        return f"correct the mapping of the import: {lines}" + (f"; or import {self.options}" if self.options else "")


def merged(mapping: Mapping[str, Any], correction: Correction) -> dict[str, Any]:
    """A mapping (values of its YAML) with the lines of a correction added."""
    made = dict(mapping)
    for key, value in correction.items():
        made[key] = {**made.get(key, {}), **value} if isinstance(value, dict) else value
    return made


def flow(value: Any) -> str:
    """A value as YAML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(flow, value)) + "]"
    if isinstance(value, str):
        plain = value and all(c.isalnum() or c in "_./^" for c in value) and not value[0].isdigit() and value[0] != "."
        words = ("y", "n", "yes", "no", "on", "off", "true", "false", "null")
        return value if plain and value.lower() not in words else yaml(value)
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def each(function: Callable[[np.ndarray], np.ndarray], streams: str) -> Change:
    """A function of one stream, (..., 3) or (..., 4), applied to some of them."""

    def apply(windows: Windows) -> Windows:
        return windows.having(**{name: function(windows.of(name)) for name in streams})

    return apply


def turned(streams: str, matrix: np.ndarray) -> Change:
    return each(lambda x: x @ matrix.T, streams)


def scaled(streams: str, factor: float) -> Change:
    return each(lambda x: x * factor, streams)


def chain(*functions: Change) -> Change:
    def apply(windows: Windows) -> Windows:
        for function in functions:
            windows = function(windows)
        return windows

    return apply


def to_world(name: str) -> Change:
    return lambda one: one.having(**{name: np.einsum("nlij,nlj->nli", one.of("rotation"), one.of(name))})


def _to_body(name: str) -> Change:
    return lambda one: one.having(**{name: np.einsum("nlji,nlj->nli", one.of("rotation"), one.of(name))})


def _with_gravity(one: Windows) -> Windows:
    return one.having(f=one.of("f") + GRAVITY * one.of("rotation")[..., 2, :])


def attitude_frames(world: np.ndarray, body: np.ndarray) -> Change:
    """R(q) -> world R(q) body^T; both (3, 3), rotations that map axes to axes."""
    from scipy.spatial.transform import Rotation

    left, right = (Rotation.from_matrix(m).as_quat(scalar_first=True) for m in (world, body.T))
    return each(lambda q: multiply(multiply(left, q), right), "q")


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
            swapped = order != (0, 1, 2)
            if not swapped:
                fault, text = "sign_flip", f"the sign of {' and '.join(flipped)} is reversed"
            else:
                fault, text = "axis_swap", f"x, y, z are ({axes_words(matrix).replace(' ', ', ')}) of the columns"
            found.append((matrix, fault, text, 1.0 + 0.5 * (len(flipped) + (1 if swapped else -1))))
    return tuple(found)


def _in_frame(streams: str, matrix: np.ndarray) -> Correction:
    """Lines that say in which axes the vectors of some streams are."""
    made = {}
    for name in streams:
        kind, word, known = ("world", "NED", NED) if name in "pv" else ("body", "FRD", FRD)
        made[KEYS[name]] = {"frame": word if (matrix == known).all() else f"{kind} {axes_words(matrix)}"}
    return made


@cache
def attitude_readings(conventions: bool = False) -> tuple[Hypothesis, ...]:
    """Orders and directions of a quaternion's columns. conventions: the usual four, one of them as mapped, alone."""
    made = [
        Hypothesis("quaternion_conjugate", "q", "world to body, not body to world", each(conjugate, "q"),
                   {"attitude": {"direction": "world_to_body"}}),
        Hypothesis("quaternion_order", "q", "the scalar is last, not first", each(scalar_last, "q"),
                   {"attitude": {"order": "xyzw"}}),
        Hypothesis("quaternion_order", "q", "the scalar is last, and world to body",
                   each(lambda q: conjugate(scalar_last(q)), "q"),
                   {"attitude": {"order": "xyzw", "direction": "world_to_body"}}, 1.5),
    ]  # fmt: skip
    if conventions:
        return (Hypothesis("", "q", "", lambda one: one, cost=0.0), *made)
    made.append(
        Hypothesis("quaternion_order", "q", "the columns are rotated by one: w, x, y, z hold z, w, x, y",
                   each(lambda q: q[..., [1, 2, 3, 0]], "q"), {"attitude": {"order": "zwxy"}}, 1.6)
    )  # fmt: skip
    return tuple(made)


def conjugate(q: np.ndarray) -> np.ndarray:
    return q * np.array([1, -1, -1, -1])


def scalar_last(q: np.ndarray) -> np.ndarray:
    """The columns w, x, y, z hold x, y, z, w."""
    return q[..., [3, 0, 1, 2]]


@cache
def hypotheses(present: frozenset[str]) -> tuple[Hypothesis, ...]:
    """Every hypothesis about the streams at hand (letters of Windows)."""
    found: list[Hypothesis] = []

    def add(name: str, streams: str, text: str, apply: Change, correction: Correction, cost: float = 1.0) -> None:
        found.append(Hypothesis(name, streams, text, apply, correction, cost))

    def as_they_are(streams: str) -> Correction:
        """Lines that keep the frames of streams when `world` and `body` of the mapping change for the attitude."""
        return {KEYS[name]: {"frame": "ENU" if name in "pv" else "FLU"} for name in streams if name in present}

    for streams, more in (("v", 0.0), ("p", 0.0), ("pv", 0.2), ("w", 0.0), ("f", 0.0), ("wf", 0.3)):
        if not set(streams) <= present:
            continue
        for matrix, fault, text, cost in signed_permutations():
            if streams[0] in "pv" and (matrix == NED).all():
                fault, text, cost = "ned_not_converted", "they are in NED (x north, y east, z down), not ENU", 1.2
            elif streams[0] in "wf" and (matrix == FRD).all():
                fault, text = "frd_not_converted", "they are in FRD (y right, z down), not FLU"
                cost = 1.1 if streams == "wf" else 1.2
            elif streams == "f" and (matrix == -np.eye(3)).all():
                text, cost = "the sign of all axes is reversed (gravity, not specific force)", 1.1
            elif streams[0] == "p" and (matrix == np.diag([1, 1, -1])).all():
                fault, text = "z_down", "z points down, not up"
            add(fault, streams, text, turned(streams, matrix), _in_frame(streams, matrix), cost + more)
    in_units = [("v", "velocity", unit) for unit in SPEEDS] + [("p", "length", unit) for unit in LENGTHS]
    for name, dimension, unit in [*in_units, ("w", "rate", "deg/s"), ("f", "acceleration", "g"),
                                  ("f", "acceleration", "mg")]:  # fmt: skip
        if name in present:
            apply = scaled(name, UNITS[dimension][unit])
            add("units", name, f"{unit}, not {next(iter(UNITS[dimension]))}", apply, {KEYS[name]: {"unit": unit}})
        if dimension == "length" and {"p", "v"} <= present:
            both: Correction = {"position": {"unit": unit}, "velocity": {"unit": f"{unit}/s"}}
            add("units", "pv", f"{unit} and {unit}/s, not m and m/s", scaled("pv", UNITS[dimension][unit]), both, 1.2)
    if "q" in present:
        if "v" in present:
            frd = chain(turned("v", FRD), to_world("v"))
            add("frame_velocity", "v", "body frame, not world", to_world("v"), {"velocity": {"frame": "body"}})
            add("frame_velocity", "v", "body frame FRD, not world", frd, {"velocity": {"frame": "FRD"}}, 1.3)
        if "w" in present:
            add("frame_rate", "w", "world frame, not body", _to_body("w"), {"rate": {"frame": "world"}})
        if "f" in present:
            plain, world = {"kind": "coordinate"}, {"frame": "world"}
            coordinate = chain(_to_body("f"), _with_gravity)
            add("frame_acceleration", "f", "world frame, not body", _to_body("f"), {"acceleration": world})
            add("gravity_removed", "f", "gravity is taken out: not specific force", _with_gravity,
                {"acceleration": plain}, 1.1)  # fmt: skip
            add("gravity_removed", "f", "coordinate acceleration in the world frame", coordinate,
                {"acceleration": world | plain}, 1.4)  # fmt: skip
        found += attitude_readings()
        motion = "".join(name for name in "pv" if name in present)
        sensors = "".join(name for name in "wf" if name in present)
        to_ned, to_frd = attitude_frames(NED, np.eye(3)), attitude_frames(np.eye(3), FRD)
        ned = chain(to_ned, to_frd)
        add("ned_not_converted", "q", "FRD to NED, not FLU to ENU", ned,
            {"world": "NED", "body": "FRD", **as_they_are("pvwf")}, 1.2)  # fmt: skip
        add("ned_not_converted", "q", "the world is NED, not ENU", to_ned, {"world": "NED", **as_they_are("pv")}, 1.3)
        add("frd_not_converted", "q", "the body is FRD, not FLU", to_frd, {"body": "FRD", **as_they_are("wf")}, 1.3)
        for k, axis in enumerate("xyz"):
            sign = np.ones(4)
            sign[k + 1] = -1
            add("sign_flip", "q", f"the sign of q_{axis} is reversed", turned("q", np.diag(sign)),
                {"attitude": {"scale": sign.astype(int).tolist()}}, 1.4)  # fmt: skip
        every = chain(turned(motion, NED), ned, turned(sensors, FRD))
        add("ned_not_converted", f"{motion}q{sensors}", "all is in NED and FRD", every,
            {"world": "NED", "body": "FRD"}, 1.4)  # fmt: skip
        world_of_all = chain(turned(motion, NED), to_ned)
        add("ned_not_converted", f"{motion}q", "the world is NED, not ENU", world_of_all, {"world": "NED"}, 1.4)
        if sensors:
            body_of_all = chain(to_frd, turned(sensors, FRD))
            add("frd_not_converted", f"q{sensors}", "the body is FRD, not FLU", body_of_all, {"body": "FRD"}, 1.3)
    return tuple(found)


def clock_hypothesis(gain: float) -> Hypothesis:
    """The clock runs `gain` times too fast, so that every rate of change is too small by that factor."""
    known = {"ms": 1e3, "us": 1e6, "ns": 1e9}
    unit = next((unit for unit, factor in known.items() if abs(gain / factor - 1) < 0.05), None)
    correction: Correction = {"time": {"unit": unit} if unit else {"scale": _digits(1 / gain)}}
    text = f"{unit}, not s" if unit else f"the clock runs {gain:.4g} times as fast as the motion"
    return Hypothesis("units" if unit else "clock_scale", "t", text, lambda one: one.having(t=one.t / gain), correction)


def scale_hypotheses(gain: float, streams: str) -> tuple[Hypothesis, ...]:
    """One of two streams is too large by a factor that no unit explains; `gain`: of the first over the second."""
    first, second = streams[0], streams[1]

    def scale(name: str, factor: float, cost: float) -> Hypothesis:
        correction = {KEYS[name]: {"scale": _digits(1 / factor)}}
        return Hypothesis("scale", name, f"{factor:.4g} times too large", scaled(name, 1 / factor), correction, cost)

    return (scale(first, gain, 1.3), *([scale(second, 1 / gain, 1.4)] if second == "p" else []))


def _digits(factor: float) -> float:
    return float(f"{factor:.5g}")
