"""What may be wrong with a log, as a table: the fault, what the data are, and the lines of the mapping that mend it.

What a line does to the streams is what the import does with it (quadexp/log/importers/raw.py), so that a candidate
that explains a flight is its correction too. Frames: world ENU from NED is (y, x, -z), body FLU from FRD (x, -y, -z);
both are their own inverse.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import permutations, product
from typing import Any

import numpy as np

from quadexp.log.importers.mapping import correction
from quadexp.log.importers.raw import corrected
from quadexp.log.signal import Stream
from quadexp.log.signal.windows import STREAMS, Windows
from quadexp.log.units import axes_matrix, axes_words
from quadexp.messages import yaml

COLUMNS = {"p": "p_*", "v": "v_*", "w": "w_*", "f": "acc_*", "q": "q_*", "t": "t"}
KEYS = {"p": "position", "v": "velocity", "w": "rate", "f": "acceleration", "q": "attitude"}

Correction = dict[str, Any]  # lines of a mapping, such as {"world": "NED", "rate": {"unit": "deg/s"}}
Row = tuple[str, str, str, Correction, float]  # fault, streams, what the data are, correction, cost


@dataclass(frozen=True)
class Candidate:
    """fault: its name. streams: what it changes, letters of Windows. text: what the data are, one phrase.

    cost: how much it claims; of two that explain a flight alike, the one that claims less is taken. severity, options
    (of the import, that do the same): of the finding.
    """

    fault: str
    streams: str
    text: str
    correction: Correction
    cost: float = 1.0
    severity: str = "blocking"
    options: str = ""

    @property
    def blocks(self) -> bool:
        return self.severity == "blocking"

    @property
    def where(self) -> str:
        return ", ".join(COLUMNS[stream] for stream in self.streams)

    @property
    def lines(self) -> list[str]:
        """The lines of the mapping, as they stand there."""
        return [flow({key: value})[1:-1] for key, value in self.correction.items()]

    @cached_property
    def mapping(self) -> Any:
        """The correction as the import reads it."""
        return correction(self.correction, {key: len(STREAMS[name]) for name, key in KEYS.items()})

    def apply(self, windows: Windows) -> Windows:
        """The streams as an import with the correction has them. Raises DataError where an attitude is none."""
        t = windows.t.ravel()
        flat = {KEYS[name]: Stream(t, x.reshape(len(t), -1)) for name, x in windows.streams.items()}
        made = corrected(flat, self.mapping)
        streams = {name: made[KEYS[name]].values.reshape(x.shape) for name, x in windows.streams.items()}
        changed = Windows(windows.t * self.mapping.clock.factor, streams)
        if "q" in streams and "q" not in self.streams:
            changed.__dict__["rotation"] = windows.rotation  # it costs as much as all else
        return changed


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


# ------------------------------------------------------------------------------------------------------------ the table
READINGS: tuple[tuple[str, str, Correction, float], ...] = (  # of a quaternion's columns
    ("quaternion_conjugate", "world to body, not body to world", {"direction": "world_to_body"}, 1.0),
    ("quaternion_order", "the scalar is last, not first", {"order": "xyzw"}, 1.0),
    ("quaternion_order", "the scalar is last, and world to body", {"order": "xyzw", "direction": "world_to_body"}, 1.5),
    ("quaternion_order", "the columns are rotated by one: w, x, y, z hold z, w, x, y", {"order": "zwxy"}, 1.6),
    *(("sign_flip", f"the sign of q_{axis} is reversed", {"scale": [1, *(-1 if a == axis else 1 for a in "xyz")]}, 1.4)
      for axis in "xyz"),
)  # fmt: skip
VECTORS: tuple[Row, ...] = (  # units and frames of vectors
    *(("units", "v", f"{unit}, not m/s", {"velocity": {"unit": unit}}, 1.0)
      for unit in ("cm/s", "mm/s", "km/h", "ft/s", "kn")),
    *(("units", "p", f"{unit}, not m", {"position": {"unit": unit}}, 1.0) for unit in ("cm", "mm", "ft")),
    *(("units", "pv", f"{unit} and {unit}/s, not m and m/s",
       {"position": {"unit": unit}, "velocity": {"unit": f"{unit}/s"}}, 1.2) for unit in ("cm", "mm", "ft")),
    ("units", "w", "deg/s, not rad/s", {"rate": {"unit": "deg/s"}}, 1.0),
    *(("units", "f", f"{unit}, not m/s^2", {"acceleration": {"unit": unit}}, 1.0) for unit in ("g", "mg")),
    ("frame_velocity", "v", "body frame, not world", {"velocity": {"frame": "body"}}, 1.0),
    ("frame_velocity", "v", "body frame FRD, not world", {"velocity": {"frame": "FRD"}}, 1.3),
    ("frame_rate", "w", "world frame, not body", {"rate": {"frame": "world"}}, 1.0),
    ("frame_acceleration", "f", "world frame, not body", {"acceleration": {"frame": "world"}}, 1.0),
    ("gravity_removed", "f", "gravity is taken out: not specific force", {"acceleration": {"kind": "coordinate"}}, 1.1),
    ("gravity_removed", "f", "coordinate acceleration in the world frame",
     {"acceleration": {"frame": "world", "kind": "coordinate"}}, 1.4),
)  # fmt: skip
# What a signed permutation of a stream's axes is called where it has a name: fault, text, cost.
KNOWN = {
    ("pv", "y x -z"): ("ned_not_converted", "they are in NED (x north, y east, z down), not ENU", 1.2),
    ("wf", "x -y -z"): ("frd_not_converted", "they are in FRD (y right, z down), not FLU", 1.2),
    ("f", "-x -y -z"): ("sign_flip", "the sign of all axes is reversed (gravity, not specific force)", 1.1),
    ("p", "x y -z"): ("z_down", "z points down, not up", 1.0),
}


@cache
def candidates(present: frozenset[str]) -> tuple[Candidate, ...]:
    """Every row of the table about the streams at hand (letters of Windows)."""
    rows = [*_axes(), *VECTORS, *(("q" in present and _attitudes(present)) or ())]
    framed = ("frame_velocity", "frame_rate", "frame_acceleration", "gravity_removed")
    return tuple(
        Candidate(fault, streams, text, lines, cost)
        for fault, streams, text, lines, cost in rows
        if set(streams) <= present and not (fault in framed and "q" not in present)
    )


def _axes() -> Iterator[Row]:
    """The 47 ways to name and sign three axes wrongly, for every stream of vectors and what comes of one sensor."""
    for streams, more in (("v", 0.0), ("p", 0.0), ("pv", 0.2), ("w", 0.0), ("f", 0.0), ("wf", 0.3)):
        kind, usual = ("world", "NED") if streams[0] in "pv" else ("body", "FRD")
        for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
            matrix = np.eye(3)[list(order)] * np.array(signs)[:, None]
            words, flipped = axes_words(matrix), [a for a, sign in zip("xyz", signs, strict=True) if sign < 0]
            if words == "x y z":
                continue
            swapped = order != (0, 1, 2)
            fault, text = "sign_flip", f"the sign of {' and '.join(flipped)} is reversed"
            if swapped:
                fault, text = "axis_swap", f"x, y, z are ({words.replace(' ', ', ')}) of the columns"
            cost = 1.0 + 0.5 * (len(flipped) + (1 if swapped else -1))
            for (letters, axes), named in KNOWN.items():
                if axes == words and set(streams) <= set(letters):
                    fault, text, cost = named
            frame = usual if (matrix == axes_matrix(kind, usual, "")).all() else f"{kind} {words}"
            yield fault, streams, text, {KEYS[name]: {"frame": frame} for name in streams}, cost + more


def _attitudes(present: frozenset[str]) -> Iterator[Row]:
    """Readings of the attitude, and frames that it shares with other streams or has alone."""
    for fault, text, lines, cost in READINGS:
        yield fault, "q", text, {"attitude": lines}, cost
    motion, sensors = ("".join(name for name in names if name in present) for names in ("pv", "wf"))

    def alone(names: str) -> Correction:
        """Lines that keep the frames of other streams."""
        return {KEYS[name]: {"frame": "ENU" if name in "pv" else "FLU"} for name in names}

    ned, frd = {"world": "NED"}, {"body": "FRD"}
    yield "ned_not_converted", "q", "FRD to NED, not FLU to ENU", ned | frd | alone(motion + sensors), 1.2
    yield "ned_not_converted", "q", "the world is NED, not ENU", ned | alone(motion), 1.3
    yield "frd_not_converted", "q", "the body is FRD, not FLU", frd | alone(sensors), 1.3
    yield "ned_not_converted", f"{motion}q{sensors}", "all is in NED and FRD", ned | frd, 1.4
    yield "ned_not_converted", f"{motion}q", "the world is NED, not ENU", ned, 1.4
    if sensors:
        yield "frd_not_converted", f"q{sensors}", "the body is FRD, not FLU", frd, 1.3


def clock_candidate(gain: float) -> Candidate:
    """The clock runs `gain` times too fast, so that every rate of change is too small by that factor."""
    known = {"ms": 1e3, "us": 1e6, "ns": 1e9}
    unit = next((unit for unit, factor in known.items() if abs(gain / factor - 1) < 0.05), None)
    lines: Correction = {"time": {"unit": unit} if unit else {"scale": _digits(1 / gain)}}
    text = f"{unit}, not s" if unit else f"the clock runs {gain:.4g} times as fast as the motion"
    return Candidate("units" if unit else "clock_scale", "t", text, lines)


def scale_candidates(gain: float, streams: str) -> tuple[Candidate, ...]:
    """One of two streams is too large by a factor that no unit explains; `gain`: of the first over the second."""
    factors = [(streams[0], gain, 1.3), *([("p", 1 / gain, 1.4)] if streams[1] == "p" else [])]
    return tuple(
        Candidate("scale", name, f"{factor:.4g} times too large", {KEYS[name]: {"scale": _digits(1 / factor)}}, cost)
        for name, factor, cost in factors
    )


def _digits(factor: float) -> float:
    return float(f"{factor:.5g}")
