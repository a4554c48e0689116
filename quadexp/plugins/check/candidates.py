"""What may be wrong with a log, as a table: the fault, what the data are, and the lines of the mapping that mend it.

What a line does to the streams is what the import does with it (quadexp/plugins/logs/importers/raw.py), so that a
candidate that explains a flight is its correction too. Frames: world ENU from NED is (y, x, -z), body FLU from FRD
(x, -y, -z); both are their own inverse.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations, permutations, product
from typing import Any

import numpy as np

from quadexp.messages import yaml
from quadexp.plugins.logs.importers.mapping import correction
from quadexp.plugins.logs.importers.raw import corrected
from quadexp.plugins.logs.signal import Stream
from quadexp.plugins.logs.signal.windows import STREAMS, Windows
from quadexp.plugins.logs.units import UNITS, axes_matrix, axes_words

COLUMNS = {"p": "p_*", "v": "v_*", "w": "w_*", "f": "acc_*", "q": "q_*", "t": "t"}
KEYS = {"p": "position", "v": "velocity", "w": "rate", "f": "acceleration", "q": "attitude"}
LETTERS = {key: letter for letter, key in KEYS.items()}

DIMENSIONS = {"p": "length", "v": "velocity", "w": "rate", "f": "acceleration"}
# Of YAML: neither a number nor one of its words for yes and no.
PLAIN_WORD = re.compile(r"(?!(?:y|n|yes|no|on|off|true|false|null)$)[^\W\d][\w./^]*", re.IGNORECASE)

Correction = dict[str, Any]  # lines of a mapping, such as {"world": "NED", "rate": {"unit": "deg/s"}}
Reading = tuple[str, str, Correction, float]  # of an attitude: fault, what the data are, correction, cost
Row = tuple[str, str, str, Correction, float]  # fault, streams, what the data are, correction, cost


@dataclass(frozen=True)
class Candidate:
    """fault: its name. streams: what it changes, letters of Windows. text: what the data are, one phrase.

    cost: how much it claims; of two that explain a flight alike, the one that claims less is taken. severity, options
    (of the import, that do the same): of the finding. axes: whose size it changes.
    """

    fault: str
    streams: str
    text: str
    correction: Correction
    cost: float = 1.0
    severity: str = "blocking"
    options: str = ""
    axes: tuple[int, ...] = (0, 1, 2)

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
        mended = corrected(flat, self.mapping)
        streams = {name: mended[KEYS[name]].values.reshape(x.shape) for name, x in windows.streams.items()}
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
    if isinstance(value, float):
        return f"{value:.10g}"
    if isinstance(value, str) and PLAIN_WORD.fullmatch(value):
        return value
    return yaml(value)


# ------------------------------------------------------------------------------------------------------------ the table
READINGS: tuple[Reading, ...] = (  # of a quaternion's columns
    ("quaternion_conjugate", "world to body, not body to world", {"direction": "world_to_body"}, 1.0),
    ("quaternion_order", "the scalar is last, not first", {"order": "xyzw"}, 1.0),
    ("quaternion_order", "the scalar is last, and world to body", {"order": "xyzw", "direction": "world_to_body"}, 1.5),
    ("quaternion_order", "the columns are rotated by one: w, x, y, z hold z, w, x, y", {"order": "zwxy"}, 1.6),
    *(("sign_flip", f"the sign of q_{axis} is reversed", {"scale": [1, *(-1 if a == axis else 1 for a in "xyz")]}, 1.4)
      for axis in "xyz"),
)  # fmt: skip
ANGLES: tuple[Reading, ...] = tuple(  # of roll, pitch and yaw
    ("sign_flip", f"the sign of {' and '.join(names)} is reversed",
     {"angles": [-1 if name in names else 1 for name in ("roll", "pitch", "yaw")]}, 0.9 + 0.3 * len(names))
    for count in (1, 2, 3) for names in combinations(("roll", "pitch", "yaw"), count)
)  # fmt: skip
FORCE_SCALE_BLOCKS = 0.08  # what a bias along z looks like
FRAMES_OF_VECTORS: tuple[Row, ...] = (  # which an attitude turns between world and body
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
    rows = [*_axes(), *_units()]
    if "q" in present:
        rows += [*FRAMES_OF_VECTORS, *_attitudes(present)]
    return tuple(Candidate(*row) for row in rows if set(row[1]) <= present)


def _units() -> Iterator[Row]:
    """Every unit of a stream, and of position and velocity together."""
    for stream, dimension in DIMENSIONS.items():
        si, *others = UNITS[dimension]
        for unit in others:
            yield "units", stream, f"{unit}, not {si}", {KEYS[stream]: {"unit": unit}}, 1.0
    for unit in ("cm", "mm", "ft"):
        lines = {"position": {"unit": unit}, "velocity": {"unit": f"{unit}/s"}}
        yield "units", "pv", f"{unit} and {unit}/s, not m and m/s", lines, 1.2


def _axes() -> Iterator[Row]:
    """The 47 ways to name and sign three axes wrongly, for every stream of vectors and what comes of one sensor."""
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        matrix = np.eye(3)[list(order)] * np.array(signs)[:, None]
        words = axes_words(matrix)
        flipped = [axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0]
        fault = "axis_swap"
        text = f"x, y, z are ({words.replace(' ', ', ')}) of the columns"
        cost = 1.5 + 0.5 * len(flipped)
        if words == "x y z":
            continue
        if order == (0, 1, 2):
            fault = "sign_flip"
            text = f"the sign of {' and '.join(flipped)} is reversed"
            cost -= 1.0
        for streams, more in (("v", 0.0), ("p", 0.0), ("pv", 0.2), ("w", 0.0), ("f", 0.0), ("wf", 0.3)):
            known = (fault, text, cost)
            for (letters, axes), named in KNOWN.items():
                if axes == words and set(streams) <= set(letters):
                    known = named
            kind = "body"
            usual = "FRD"
            if streams[0] in "pv":
                kind = "world"
                usual = "NED"
            frame = f"{kind} {words}"
            if (matrix == axes_matrix(kind, usual, "")).all():
                frame = usual
            name, what, claim = known
            yield name, streams, what, {KEYS[stream]: {"frame": frame} for stream in streams}, claim + more


def _attitudes(present: frozenset[str]) -> Iterator[Row]:
    """Readings of the attitude, and frames that it shares with other streams or has alone."""
    for fault, text, lines, cost in READINGS + ANGLES:
        yield fault, "q", text, {"attitude": lines}, cost
    motion = "".join(name for name in "pv" if name in present)
    sensors = "".join(name for name in "wf" if name in present)
    ned = {"world": "NED"}
    frd = {"body": "FRD"}
    in_enu: Correction = {KEYS[name]: {"frame": "ENU"} for name in motion}  # lines that keep the frames of the others
    in_flu: Correction = {KEYS[name]: {"frame": "FLU"} for name in sensors}
    yield "ned_not_converted", "q", "FRD to NED, not FLU to ENU", ned | frd | in_enu | in_flu, 1.2
    yield "ned_not_converted", "q", "the world is NED, not ENU", ned | in_enu, 1.3
    yield "frd_not_converted", "q", "the body is FRD, not FLU", frd | in_flu, 1.3
    yield "ned_not_converted", f"{motion}q{sensors}", "all is in NED and FRD", ned | frd, 1.4
    yield "ned_not_converted", f"{motion}q", "the world is NED, not ENU", ned, 1.4
    if sensors:
        yield "frd_not_converted", f"q{sensors}", "the body is FRD, not FLU", frd, 1.3


def clock_candidate(gain: float) -> Candidate:
    """The clock runs `gain` times too fast, so that every rate of change is too small by that factor."""
    for unit, seconds in UNITS["time"].items():
        if seconds < 1 and abs(gain * seconds - 1) < 0.05:
            return Candidate("units", "t", f"{unit}, not s", {"time": {"unit": unit}})
    text = f"the clock runs {gain:.4g} times as fast as the motion"
    return Candidate("clock_scale", "t", text, {"time": {"scale": float(f"{1 / gain:.5g}")}})


def scale_candidates(gain: float, streams: str) -> tuple[Candidate, ...]:
    """One of these streams has a factor that no unit explains; `gain`: of the first over the second."""
    candidates = []
    for i, name in enumerate(streams):
        size = gain if i == 0 else 1 / gain
        lines = {KEYS[name]: {"scale": float(f"{1 / size:.5g}")}}
        severity = "warning" if name == "f" and abs(size - 1) < FORCE_SCALE_BLOCKS else "blocking"
        text = f"{size:.4g} times their true size"
        candidates.append(Candidate("scale", name, text, lines, 1.3 + 0.1 * i, severity))
    return tuple(candidates)
