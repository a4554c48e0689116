"""The conventions of a log: every reading of its attitude with every direction of up, scored as in search.py.

A convention is a hypothesis about all streams at once: order and direction of the quaternion, world and body frame, the
sensors' own axes and units, a velocity in the body. What it explains is by how much it lowers J (search.py) below that
of the same log with sensors that say nothing, so that conventions with different columns can be compared. The axes of a
sensor need not be tried one by one: of all rotations S that map axes to axes, the one with the largest trace of
S^T (y x^T) brings x nearest to y, whatever the unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from quadexp.log.hypotheses.hypothesis import (
    Correction,
    Hypothesis,
    attitude_frames,
    attitude_readings,
    chain,
    merged,
    to_world,
    turned,
)
from quadexp.log.hypotheses.search import TIE, agreement
from quadexp.log.hypotheses.windows import FLOOR, Windows, body_rate, changes, means, pairs, window_starts
from quadexp.log.signal import continuous
from quadexp.log.units import UNITS, axes_matrix, axes_words

UPS = {  # direction of up in the log's world: its frame, a phrase, cost
    "z": ("ENU", "z up; which way x points from north cannot be known from the data", 0.0),
    "-z": ("NED", "z down", 0.1),
    "y": ("z x y", "y up", 2.5), "-y": ("x -z y", "y down", 2.5),
    "x": ("y z x", "x up", 2.5), "-x": ("z y -x", "x down", 2.5),
}  # fmt: skip
BODIES = {"z": "FLU", "-z": "FRD", "y": "z x y", "-y": "x z -y", "x": "y z x", "-x": "z y -x"}  # where thrust points
TURNED = 2.5  # cost of a sensor whose axes are not the attitude's
PLAIN = 0.03  # of correlation, by which turned axes have to fit better than the sensor's own
RATE, FORCE, MOTION = 0.5, 0.9, 0.85  # correlations with what the motion says, for columns to be taken for a sensor's
GRID = 100.0  # Hz
MOST = 8000  # samples looked at


class Table:
    """Columns of a log on one clock. t: (k,) s, uniform. x: (k, N). times, windows: (n, l), (n, l, N), and means and
    slopes over their halves, (2n, N)."""

    def __init__(self, t: np.ndarray, columns: np.ndarray) -> None:
        """The middle of a log of columns (k, N) at times t (k,); empty cells are bridged."""
        later = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]])
        t, columns = t[later], columns[later]
        period = max(float(np.median(np.diff(t))), 1 / GRID)
        length = min(t[-1] - t[0], MOST * period)
        start = 0.5 * (t[0] + t[-1] - length)
        self.t = start + np.arange(int(length / period) + 1) * period
        self.x = np.empty((len(self.t), columns.shape[1]))
        for i, column in enumerate(columns.T):
            good = np.isfinite(column)
            self.x[:, i] = np.interp(self.t, t[good], column[good]) if good.sum() > 1 else np.nan
        starts, half = window_starts(self.t, np.ones(len(self.t), bool))
        samples = starts[:, None] + np.arange(2 * half + 1)
        self.times, self.windows = self.t[samples], self.x[samples]
        self.means, self.slopes = means(self.times, self.windows), changes(self.times, self.windows)

    def over(self, columns: list[int], like: np.ndarray) -> np.ndarray:
        """Means of some columns over half windows or, where `like` (n, 3) has no more, over whole ones."""
        x = self.means[:, columns]
        return x if len(x) == len(like) else x.reshape(2, len(like), -1).mean(axis=0)

    @cached_property
    def correlations(self) -> np.ndarray:
        """Of every column's slope with every column's mean, (N, N); 0 where one does not move."""
        a, b = self.slopes - self.slopes.mean(axis=0), self.means - self.means.mean(axis=0)
        size = np.outer(np.sqrt((a * a).sum(axis=0)), np.sqrt((b * b).sum(axis=0)))
        return np.nan_to_num(np.divide(a.T @ b, size, out=np.zeros_like(size), where=size > 0))

    def is_unit(self, columns: list[int]) -> bool:
        """Whether four columns are a unit quaternion that moves."""
        x = self.x[:, columns]
        norm = np.sqrt((x * x).sum(axis=1))
        off = np.quantile(np.abs(norm - 1), 0.9) if np.isfinite(x).all() else 1.0
        return bool(off < 0.02 and norm.min() > 1e-3 and np.ptp(x, axis=0).max() > 1e-3)


class Sensor(NamedTuple):
    """columns of a gyro or accelerometer. matrix: S, (3, 3), its axes to the attitude's body, where it correlates best
    with what the motion says. gain: of that over S x."""

    columns: list[int]
    matrix: np.ndarray
    correlation: float
    gain: float

    @property
    def plain(self) -> bool:
        return bool((self.matrix == np.eye(3)).all())

    @property
    def rate_unit(self) -> tuple[str, bool]:
        """Unit of a gyro, and whether the gain is near it; freed of what noise in the gyro takes off the slope."""
        gain = self.gain / max(self.correlation**2, 1e-6)
        apart = {unit: abs(np.log(max(gain, 1e-9) / factor)) for unit, factor in UNITS["rate"].items()}
        unit = min(apart, key=lambda name: apart[name])
        return unit, apart[unit] < 0.7


@dataclass(frozen=True)
class Reading:
    """An attitude read one way. columns: of the log. q: (n, l, 4), w first, as the windows have it. unit: of angles."""

    columns: list[int]
    q: np.ndarray
    hypothesis: Hypothesis
    unit: str = ""


@dataclass(frozen=True)
class Motion:
    """position, velocity: columns, None where there is none. length, speed: their units. in_body: of the velocity.
    gain: of the velocity over the derivative of the position, as logged. correlation: of the two."""

    position: list[int] | None = None
    velocity: list[int] | None = None
    length: str = "m"
    speed: str = "m/s"
    in_body: bool = False
    gain: float = 1.0
    correlation: float = 0.0


@dataclass(frozen=True)
class Convention:
    """up: in the log's world, thrust: in the attitude's body frame, signed axes. correction: lines of the mapping.
    value: by how much it lowers J below that of sensors that say nothing, its cost taken off."""

    reading: Reading
    motion: Motion
    up: str
    thrust: str
    force: Sensor | None
    rate: Sensor | None
    correction: Correction
    value: float


@cache
def turns() -> np.ndarray:
    """The 24 rotations that map axes to axes, (24, 3, 3), the identity first, then turns of fewest axes."""
    made = [np.diag(signs) @ np.eye(3)[list(order)] for order in permutations(range(3))
            for signs in product((1.0, -1.0), repeat=3)]  # fmt: skip
    return np.array(sorted((m for m in made if np.linalg.det(m) > 0), key=lambda m: -np.trace(m)))


def fitted(table: Table, columns: list[int], expected: np.ndarray, *, centred: bool) -> Sensor:
    """The axes and gain with which three columns fit what is expected of them, (n, 3), best; their own where others fit
    little better. centred: whether means are taken off (an offset of a gyro), or part of the fit (gravity)."""
    x, y = table.over(columns, expected), expected
    if centred:
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    nx, ny = float(np.sqrt((x * x).sum())), float(np.sqrt((y * y).sum()))
    if nx == 0 or ny == 0:
        return Sensor(columns, np.eye(3), 0.0, 1.0)
    scores = np.einsum("kij,ij->k", turns(), y.T @ x) / (nx * ny)
    best = int(np.argmax(scores))
    best = 0 if scores[best] < scores[0] + PLAIN else best
    return Sensor(columns, turns()[best], float(scores[best]), float(scores[best]) * ny / nx)


def quaternion_readings(table: Table, columns: list[int], *, scalar_first: bool) -> list[Reading]:
    """Four columns as a quaternion in the usual orders and directions. scalar_first: whether the names say so."""
    x = table.windows[..., columns]
    q = continuous(x.reshape(-1, 4)).reshape(x.shape)
    made = []
    for one in attitude_readings(conventions=True):
        if not scalar_first or one.correction.get("attitude", {}).get("order", "wxyz") == "wxyz":
            made.append(Reading(columns, one.apply(Windows.of_streams(table.times, {"q": q})).of("q"), one))
    return made


def angle_reading(table: Table, columns: list[int], unit: str) -> Reading:
    """Three columns as roll, pitch and yaw in a unit of angle."""
    from scipy.spatial.transform import Rotation

    angles = table.windows[..., columns[::-1]] * UNITS["angle"][unit]
    q = Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_quat(scalar_first=True)
    plain = attitude_readings(conventions=True)[0]
    return Reading(columns, continuous(q).reshape(*angles.shape[:2], 4), plain, unit)


def conventions(
    table: Table, readings: Sequence[Reading], motions: Sequence[Motion], forces: list[list[int]],
    rates: list[list[int]],
) -> list[Convention]:  # fmt: skip
    """Every convention of a log, the one that explains it best first.

    motions: what position and velocity may be. forces, rates: columns that may be the accelerometer's and the gyro's,
    the likeliest first.
    """
    found = [one for reading in readings for motion in motions
             for one in _of_reading(table, reading, motion, forces, rates)]  # fmt: skip
    return sorted(found, key=lambda one: -one.value)


def _of_reading(
    table: Table, reading: Reading, motion: Motion, forces: list[list[int]], rates: list[list[int]]
) -> Iterator[Convention]:
    t = table.times
    streams = {"q": reading.q}
    if motion.position is not None:
        streams["p"] = table.windows[..., motion.position] * UNITS["length"][motion.length]
    if motion.velocity is not None:
        streams["v"] = table.windows[..., motion.velocity] * UNITS["velocity"][motion.speed]
    unknown = motion.position is None and motion.velocity is None
    if unknown:  # then gravity alone has to explain the accelerometer
        streams["v"] = np.zeros((*t.shape, 3))
    log = Windows.of_streams(t, streams)
    log = to_world("v")(log) if motion.in_body else log
    expected = {
        up: next(p.expected for p in pairs(log, up=_axis(up), touching="q") if p.relation.startswith("thrust"))
        for up in UPS
    }
    taken = set(reading.columns) | set(motion.position or ()) | set(motion.velocity or ())
    force = _best(table, [c for c in forces if not set(c) & taken], list(expected.values()), FORCE, centred=False)
    beside = force.columns if force else []
    rate = _best(table, [c for c in rates if not set(c) & {*taken, *beside}], [body_rate(t, reading.q)], RATE,
                 centred=True, beside=beside)  # fmt: skip
    for up in UPS if force or not unknown else ("z",):
        read = None if force is None else fitted(table, force.columns, expected[up], centred=False)
        pull = expected[up] if read is None else table.over(read.columns, expected[up]) @ read.matrix.T
        axis = int(np.argmax(np.abs(pull.mean(axis=0))))
        thrust = ("-" if pull.mean(axis=0)[axis] < 0 else "") + "xyz"[axis]
        yield _convention(table, log, reading, motion, up, thrust, read, rate)


def _axis(name: str) -> np.ndarray:
    """A signed axis, "-z", as a vector, (3,)."""
    return np.eye(3)["xyz".index(name[-1])] * (-1.0 if name[0] == "-" else 1.0)


def _best(
    table: Table, candidates: list[list[int]], expected: list[np.ndarray], least: float, *, centred: bool,
    beside: Sequence[int] = (),
) -> Sensor | None:  # fmt: skip
    """The columns that fit one of the expected signals best; None where none does.

    beside: the accelerometer's columns. The halves of an inertial sensor stand side by side; a rate from a camera's
    poses need not.
    """
    best, found = -np.inf, None
    for rank, columns in enumerate(candidates):
        if np.ptp(table.means[:, columns], axis=0).min() == 0:
            continue
        one = max((fitted(table, columns, e, centred=centred) for e in expected), key=lambda fit: fit.correlation)
        value = (
            one.correlation
            - 0.002 * rank
            - 0.02 * (not one.plain)
            + 0.08 * (bool(beside) and abs(columns[0] - beside[0]) == 3)
        )
        if value > best:
            best, found = value, one
    return found if found is not None and found.correlation > least else None


def _convention(
    table: Table, log: Windows, reading: Reading, motion: Motion, up: str, thrust: str, force: Sensor | None,
    rate: Sensor | None,
) -> Convention:  # fmt: skip
    """log: the attitude and the motion in SI units, in the log's frames."""
    frame, _, cost = UPS[up]
    world, body = axes_matrix("world", frame, ""), axes_matrix("body", BODIES[thrust], "")
    correction = merged(reading.hypothesis.correction, {"world": frame, "body": BODIES[thrust]})
    moving = "".join(name for name in "pv" if getattr(log, name) is not None)
    changes_ = [turned(moving, world), attitude_frames(world, body)]
    cost += reading.hypothesis.cost + motion.in_body
    sensors = {}
    for name, key, one in (("f", "acceleration", force), ("w", "rate", rate)):
        if one is None:
            continue
        factor = one.gain if name == "f" else UNITS["rate"][one.rate_unit[0]]
        sensors[name] = table.windows[..., one.columns]
        changes_.append(turned(name, factor * body @ one.matrix))
        if not one.plain:
            cost += TURNED
            correction = merged(correction, {key: {"frame": f"body {axes_words(body @ one.matrix)}"}})
    if motion.in_body:
        correction = merged(correction, {"velocity": {"frame": "body"}})
    value = _explained(chain(*changes_)(log.having(**sensors))) - TIE * cost
    return Convention(reading, motion, up, thrust, force, rate, correction, value)


def _explained(windows: Windows) -> float:
    """By how much J is below that of a log in which every sensor reads zero."""
    made = 0.0
    for pair in pairs(windows):
        pair = replace(pair, floor=min(pair.floor, FLOOR["force"]))  # drag is the same in every convention
        silent = replace(pair, found=0 * pair.found)
        if pair.relation.startswith("thrust"):  # there is no sensor: a force in any direction says nothing
            size = np.linalg.norm(pair.expected, axis=1, keepdims=True) / np.sqrt(3)
            silent = replace(silent, expected=np.broadcast_to(size, pair.expected.shape))
        made += agreement(silent).score - agreement(pair).score
    return made
