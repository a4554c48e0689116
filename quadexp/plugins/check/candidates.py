"""What may be wrong with a log, as a table: the fault, what the data are, and the lines of the mapping that mend it.

What a line does to the streams is what the import does with it (quadexp/plugins/logs/importers/raw.py), so that a
candidate that explains a flight is its correction too. Frames: world ENU from NED is (y, x, -z), body FLU from FRD
(x, -y, -z); both are their own inverse.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations, permutations, product
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.messages import yaml
from quadexp.physics.state import norms
from quadexp.plugins.logs.importers.mapping import correction
from quadexp.plugins.logs.importers.raw import corrected
from quadexp.plugins.logs.signal import Stream
from quadexp.plugins.logs.signal.windows import RELATIONS, STREAMS, UP, Pair, Windows, middles, pairs
from quadexp.plugins.logs.units import UNITS, axes_matrix, axes_words

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
    def axes(self) -> tuple[int, ...]:
        """Axes whose size it changes; all where it says nothing of single ones."""
        for lines in self.correction.values():
            factors = lines.get("scale") if isinstance(lines, dict) else None
            if isinstance(factors, list) and len(factors) == 3:
                return tuple(i for i, factor in enumerate(factors) if factor != 1.0)
        return (0, 1, 2)

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
ANGLES = ("roll", "pitch", "yaw")
READINGS += tuple(
    ("sign_flip", f"the sign of {' and '.join(names)} is reversed",
     {"angles": [-1 if name in names else 1 for name in ANGLES]}, 0.9 + 0.3 * len(names))
    for count in (1, 2, 3) for names in combinations(ANGLES, count)
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
    unit = next((unit for unit, size in UNITS["time"].items() if size < 1 and abs(gain * size - 1) < 0.05), None)
    lines = {"time": {"unit": unit} if unit else {"scale": float(f"{1 / gain:.5g}")}}
    text = f"{unit}, not s" if unit else f"the clock runs {gain:.4g} times as fast as the motion"
    return Candidate("units" if unit else "clock_scale", "t", text, lines)


def scale_candidates(gain: float, streams: str) -> tuple[Candidate, ...]:
    """One of these streams has a factor that no unit explains; `gain`: of the first over the second."""
    factors = [(name, gain if name == streams[0] else 1 / gain, 1.3 + 0.1 * i) for i, name in enumerate(streams)]
    candidates = []
    for name, size, cost in factors:
        severity = "warning" if name == "f" and abs(size - 1) < FORCE_SCALE_BLOCKS else "blocking"
        lines = {KEYS[name]: {"scale": float(f"{1 / size:.5g}")}}
        candidates.append(Candidate("scale", name, f"{size:.4g} times their true size", lines, cost, severity))
    return tuple(candidates)


# ----------------------------------------------------------------------------------------------------- bias and heading
# By stream: relation, the least bias that is named, the largest that a sensor has, unit.
BIAS = {"w": ("rate", 0.03, 1.0, "rad/s"), "f": ("force", 0.5, 3.0, "m/s^2")}
BIAS_SURE = 5.0  # standard errors
FORCE_SCALE_BLOCKS = 0.08  # what a bias along z looks like
LEAST_YAW, YAW_BLOCKS = 2.0, 8.0  # deg


def bias_candidates(windows: Windows) -> list[Candidate]:
    """A constant that a gyro or an accelerometer adds, where the flight shows one."""
    known = {pair.name: pair for pair in pairs(windows)}
    candidates = []
    for stream, (relation, least, most, unit) in BIAS.items():
        pair = known.get(relation) or known.get(f"{relation} (p)")
        if pair is None:
            continue
        gap = pair.measured - pair.expected
        stretch = stretches_of(len(gap), len(windows.t))
        medians = np.array([np.median(gap[stretch == k], axis=0) for k in np.unique(stretch)])
        error = medians.std(axis=0, ddof=1) / np.sqrt(len(medians)) if len(medians) > 2 else np.full(3, np.inf)
        bias = np.where(np.abs(np.median(gap, axis=0)) > BIAS_SURE * error, np.median(gap, axis=0), 0.0)
        if not least <= np.abs(bias).max() <= most:
            continue
        offset = [float(f"{x:.3g}") + 0.0 for x in bias]
        text = f"a bias of {', '.join(f'{x:g}' for x in offset)} {unit}"
        candidates.append(Candidate("bias", stream, text, {KEYS[stream]: {"offset": offset}}, 1.7, "warning"))
    return candidates


def world_acceleration(windows: Windows) -> tuple[np.ndarray, np.ndarray] | None:
    """What velocity or position and what the accelerometer say, both with g, in the world, (2n, 3) of halves of the
    windows, or (n, 3); None where a stream is missing."""
    known = {pair.name: pair for pair in pairs(windows)}
    pair = known.get("force") or known.get("force (p)")
    if pair is None:
        return None
    half = windows.t.shape[1] // 2
    turn = windows.rotation[:, half] if pair.name.endswith("(p)") else middles(windows.rotation)
    return np.einsum("nij,nj->ni", turn, pair.expected), np.einsum("nij,nj->ni", turn, pair.measured)


def heading_candidates(windows: Windows) -> list[Candidate]:
    """A heading of the attitude that is turned about the vertical against position and velocity:

    min over psi of sum_k |a_k - R_z(psi) R_k f_k|^2,  horizontal components.
    """
    sides = world_acceleration(windows)
    if sides is None:
        return []
    x, y = (side[:, :2] - side[:, :2].mean(axis=0) for side in sides)
    stretch = stretches_of(len(x), len(windows.t))

    def angle(rows: np.ndarray) -> float:
        a, b = x[rows], y[rows]
        return float(np.degrees(np.arctan2(np.sum(b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0]), np.sum(a * b))))

    yaw = angle(np.ones(len(x), bool))
    rest = np.array([angle(stretch != k) for k in np.unique(stretch)])
    apart = (rest - yaw + 180) % 360 - 180
    error = float(np.sqrt((len(rest) - 1) * np.var(apart)))
    if abs(yaw) < max(LEAST_YAW, BIAS_SURE * error):
        return []
    text = f"the heading is turned by {-yaw:.1f} deg (standard error {error:.1f}) against the motion"
    severity = "blocking" if abs(yaw) > YAW_BLOCKS else "warning"
    return [Candidate("heading", "q", text, {"attitude": {"turn": round(yaw, 2)}}, 1.3, severity)]


# --------------------------------------------------------------------------------------------------------- mounting
LEAST_TURN = 2.0  # deg: smaller turns are not reported
TURN_WARNS = 4.0  # deg: more than the offsets of a fit absorb
MOST_TURN = 20.0  # deg: of a mount that was never calibrated
LARGEST_TURN = 120.0  # deg: beyond, it is a convention of axes, which other candidates name
CERTAIN, CERTAIN_ALONE = 3.0, 5.0  # standard errors; of a turn about z that an accelerometer alone shows
KEPT_WINDOWS = 0.9  # of the windows: knocks are left out
STRETCHES = 10  # of the flight, for the standard errors
LEAST_MOTION = 2.0  # floors that a gyro must turn by to tell how it sits
# Streams that are turned together: relations that tell, cost, words.
SENSORS = {
    "f": (("force",), 0.5, "the accelerometer is"),
    "w": (("rate",), 0.5, "the gyro is"),
    "wf": (("force", "rate"), 0.6, "accelerometer and gyro are"),
}
OPTIONS = {"f": "--mounting", "w": "--gyro-mounting"}  # of the import


def mounting_candidates(windows: Windows) -> list[Candidate]:
    """The turn of the accelerometer, of the gyro, and of both together, where the flight tells one.

        min over M in SO(3) of sum_k |x_k - M y_k|^2         (Wahba 1965; Kabsch 1976)

    x_k: what the motion says over a window, y_k: what the sensor read. The specific force of a multirotor points along
    the body's z nearly always, so that an accelerometer alone hardly tells a turn about z: where its standard error is
    too large for what it finds, that turn is left out.
    """
    known = {pair.name: pair for pair in pairs(windows)}
    if "force (p)" in known:
        known.setdefault("force", known["force (p)"])
    turns = []
    for streams, (relations, cost, words) in SENSORS.items():
        if set(relations) <= known.keys():
            estimated = _estimate([known[name] for name in relations], len(windows.t))
            turns += [] if estimated is None else [_candidate(streams, *estimated, cost, words)]
    return turns


def _estimate(known: list[Pair], windows: int) -> tuple[Rotation, np.ndarray] | None:
    """The rotation of the measured sides of these relations onto the expected ones, and its standard errors (deg); None
    where there is none."""
    sides = []
    for name, expected, measured in known:
        floor = RELATIONS[name].floor
        if name == "rate" and np.sqrt(np.mean(np.sum(expected**2, axis=1))) < LEAST_MOTION * floor:
            return None
        if not (np.isfinite(expected).all() and np.isfinite(measured).all()):
            return None
        sides.append((expected / floor, measured / floor))
    if KEPT_WINDOWS * sum(len(x) for x, _ in sides) < 3 * STRETCHES:
        return None
    return certain_turn(*turn_of(sides, windows), alone=all(pair.name != "rate" for pair in known))


def turn_of(sides: Sequence[tuple[np.ndarray, np.ndarray]], windows: int) -> tuple[Rotation, np.ndarray]:
    """The rotation of what was read onto what the motion says, and its standard errors about x, y, z (deg), by a
    jackknife. sides: what the motion says and what was read, (n, 3) each, in floors."""
    parts = []
    for x, y in sides:
        size = norms(x - kabsch(x, y).apply(y))
        near = size <= np.quantile(size, KEPT_WINDOWS)
        parts.append((x[near], y[near], stretches_of(len(x), windows)[near]))
    x, y, part = (np.concatenate(side) for side in zip(*parts, strict=True))
    turn = kabsch(x, y)
    rest = [kabsch(x[part != k], y[part != k]) for k in np.unique(part)]
    apart = np.array([(partly * turn.inv()).as_rotvec() for partly in rest])
    return turn, np.degrees(np.sqrt((len(rest) - 1) * np.var(apart, axis=0)))


def certain_turn(turn: Rotation, error: np.ndarray, *, alone: bool) -> tuple[Rotation, np.ndarray] | None:
    """A turn that is real, None where it is not. alone: of an accelerometer, which may not tell it about z."""
    about_z = abs(np.degrees(turn.as_rotvec()[2]))
    if alone and (about_z < CERTAIN_ALONE * error[2] or error[2] > LEAST_TURN):
        turn = shortest(turn)
    spread = np.linalg.norm(error[:2] if alone else error)
    return (turn, error) if max(LEAST_TURN, CERTAIN * spread) <= np.degrees(turn.magnitude()) < LARGEST_TURN else None


def stretches_of(rows: int, windows: int) -> np.ndarray:
    """The stretch of the flight, (rows,), that each row is of; rows: a multiple of the number of windows."""
    return np.arange(rows) % windows * STRETCHES // windows


def kabsch(x: np.ndarray, y: np.ndarray) -> Rotation:
    """The rotation that brings y (n, 3) onto x (n, 3)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "not uniquely defined": its error will be large
        return Rotation.align_vectors(x, y)[0]


def shortest(turn: Rotation) -> Rotation:
    """The shortest of the turns that bring the same direction of the sensor onto the body's z."""
    up = turn.inv().apply(UP)
    axis = np.cross(up, UP)
    sine = float(np.linalg.norm(axis))
    return Rotation.from_rotvec(np.arctan2(sine, up[2]) * axis / sine) if sine > 1e-9 else Rotation.identity()


def turn_words(words: str, turn: Rotation, error: np.ndarray) -> tuple[list[float], str]:
    """Roll, pitch and yaw of a mounting (deg), and the text about it."""
    yaw, pitch, roll = turn.as_euler("ZYX", degrees=True)  # M = R_z(yaw) R_y(pitch) R_x(roll), as the mapping has it
    angles = [round(float(x), 2) + 0.0 for x in (roll, pitch, yaw)]
    listed, errors = ", ".join(f"{x:g}" for x in angles), ", ".join(f"{e:.1f}" for e in error)
    size = np.degrees(turn.magnitude())
    return angles, f"{words} turned by {size:.1f} deg: roll, pitch, yaw {listed} deg (standard errors {errors})"


def _candidate(streams: str, turn: Rotation, error: np.ndarray, cost: float, words: str) -> Candidate:
    """The mounting undone. Turns by less than MOST_TURN do not block."""
    angles, text = turn_words(words, turn, error)
    size = float(np.degrees(turn.magnitude()))
    severity = "info" if size < TURN_WARNS else "warning" if size <= MOST_TURN else "blocking"
    lines = {KEYS[name]: {"mounting": angles} for name in sorted(streams)}
    listed = ",".join(f"{angle:g}" for angle in angles)
    options = " ".join(f"{OPTIONS[name]}={listed}" for name in sorted(streams))
    return Candidate("mounting", streams, text, lines, 2.5 if severity == "blocking" else cost, severity, options)
