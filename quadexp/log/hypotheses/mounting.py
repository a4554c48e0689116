"""One constant rotation between a sensor and the body: how an accelerometer or gyro sits in its frame.

    min over M in SO(3) of sum_k |x_k - M y_k|^2         (Wahba 1965; Kabsch 1976)

x_k: what the motion says over a window, y_k: what the sensor read (windows.py). The specific force of
a multirotor points along the body's z nearly always, so that an accelerometer alone hardly tells a turn about z:
where its standard error is too large for what it finds, that turn is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from quadexp.log.hypotheses.hypothesis import KEYS, Hypothesis, turned
from quadexp.log.hypotheses.windows import Pair, Windows, pairs

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

LEAST = 2.0  # deg: smaller turns are not reported
WARNS, MOST = 4.0, 20.0  # deg: more than the offsets of a fit absorb; the most of a mount that was never calibrated
LARGEST = 120.0  # deg: beyond, it is a convention of axes, which other hypotheses name
CERTAIN, CERTAIN_ALONE = 3.0, 5.0  # standard errors; of a turn about z that an accelerometer alone shows
KEPT = 0.9  # of the windows: knocks are left out
STRETCHES = 10  # of the flight, for the standard errors
RELATIONS = {"f": ("force", "force (p)"), "w": ("rate",)}
OPTIONS = {"f": "--mounting", "w": "--gyro-mounting"}  # of the import
LEAST_MOTION = 2.0  # floors that a gyro must turn by to tell how it sits


@dataclass(frozen=True)
class Mounting:
    """matrix: (3, 3), sensor to body. error: standard error of the turn about x, y, z (deg)."""

    matrix: np.ndarray
    error: np.ndarray

    @property
    def vector(self) -> np.ndarray:
        """Rotation vector (deg)."""
        from scipy.spatial.transform import Rotation

        return np.degrees(Rotation.from_matrix(self.matrix).as_rotvec())

    @property
    def angle(self) -> float:
        """Size of the turn (deg)."""
        return float(np.linalg.norm(self.vector))

    @property
    def angles(self) -> list[float]:
        """Roll, pitch, yaw (deg): M = R_z(yaw) R_y(pitch) R_x(roll), as the mapping takes them."""
        from scipy.spatial.transform import Rotation

        yaw, pitch, roll = Rotation.from_matrix(self.matrix).as_euler("ZYX", degrees=True)
        return [round(float(x), 2) + 0.0 for x in (roll, pitch, yaw)]


def mounting_hypotheses(windows: Windows) -> list[Hypothesis]:
    """The turn of the accelerometer, of the gyro, and of both together, where the flight tells one."""
    found = {pair.relation: pair for pair in pairs(windows, touching="pqvwf")}
    made = []
    for streams, cost in (("f", 0.5), ("w", 0.5), ("wf", 0.6)):
        chosen = [next((found[r] for r in RELATIONS[s] if r in found), None) for s in streams]
        known = [one for one in chosen if one is not None]
        if len(known) < len(streams):
            continue
        one = estimate(known, len(windows.t))
        if one is not None:
            made.append(_hypothesis(streams, one, cost))
    return made


def estimate(known: list[Pair], windows: int) -> Mounting | None:
    """The rotation of the found sides of these relations onto the expected ones; None where there is none."""
    alone = all(pair.relation != "rate" for pair in known)
    expected, found, stretch = [], [], []
    for pair in known:
        if pair.relation == "rate" and np.sqrt(np.mean(np.sum(pair.expected**2, axis=1))) < LEAST_MOTION * pair.floor:
            return None
        near = _near(pair)
        expected.append(pair.expected[near] / pair.floor)
        found.append(pair.found[near] / pair.floor)
        stretch.append((np.arange(len(pair.found)) % windows * STRETCHES // windows)[near])
    x, y, part = np.concatenate(expected), np.concatenate(found), np.concatenate(stretch)
    if len(x) < 3 * STRETCHES or not (np.isfinite(x).all() and np.isfinite(y).all()):
        return None
    turn = _kabsch(x, y)
    rest = [_kabsch(x[part != k], y[part != k]) for k in np.unique(part)]
    count = len(rest)
    apart = np.array([(one * turn.inv()).as_rotvec() for one in rest])
    error = np.degrees(np.sqrt((count - 1) / count * np.sum((apart - apart.mean(axis=0)) ** 2, axis=0)))
    if alone:
        vector = np.degrees(turn.as_rotvec())
        if abs(vector[2]) < CERTAIN_ALONE * error[2] or error[2] > LEAST:
            turn = _shortest(turn)
    made = Mounting(turn.as_matrix(), error)
    size = np.linalg.norm(error[:2] if alone else error)
    if made.angle < max(LEAST, CERTAIN * float(size)):
        return None
    return made if made.angle < LARGEST else None


def _near(pair: Pair) -> np.ndarray:
    """The windows, as indices, that fit best once turned."""
    turn = _kabsch(pair.expected, pair.found)
    size = np.linalg.norm(pair.expected - turn.apply(pair.found), axis=1)
    return np.flatnonzero(size <= np.quantile(size, KEPT))


def _kabsch(x: np.ndarray, y: np.ndarray) -> Rotation:
    """The rotation that brings y (n, 3) onto x (n, 3)."""
    import warnings

    from scipy.spatial.transform import Rotation

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "not uniquely defined": its error will be large
        return Rotation.align_vectors(x, y)[0]


def _shortest(turn: Rotation) -> Rotation:
    """The shortest of the turns that bring the same direction of the sensor onto the body's z."""
    from scipy.spatial.transform import Rotation

    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(turn.inv().apply(z), z)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, float(turn.inv().apply(z) @ z))
    return Rotation.from_rotvec(angle * axis / sine) if sine > 1e-9 else Rotation.identity()


def _hypothesis(streams: str, one: Mounting, cost: float) -> Hypothesis:
    """The mounting undone. Turns by less than MOST do not block."""
    what = {"f": "the accelerometer is", "w": "the gyro is", "wf": "accelerometer and gyro are"}[streams]
    angles, error = ", ".join(f"{x:g}" for x in one.angles), ", ".join(f"{e:.1f}" for e in one.error)
    text = f"{what} turned by {one.angle:.1f} deg: roll, pitch, yaw {angles} deg (standard errors {error})"
    severity = "info" if one.angle < WARNS else "warning" if one.angle <= MOST else "blocking"
    correction = {KEYS[name]: {"mounting": one.angles} for name in sorted(streams)}
    options = " ".join(f"{OPTIONS[name]}={angles.replace(' ', '')}" for name in sorted(streams))
    cost = 2.5 if severity == "blocking" else cost
    return Hypothesis("mounting", streams, text, turned(streams, one.matrix), correction, cost, severity, options)
