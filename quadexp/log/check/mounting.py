"""One constant rotation between a sensor and the body: how an accelerometer or gyro sits in its frame.

    min over M in SO(3) of sum_k |x_k - M y_k|^2         (Wahba 1965; Kabsch 1976)

x_k: what the motion says over a window, y_k: what the sensor read (windows.py). The specific force of
a multirotor points along the body's z nearly always, so that an accelerometer alone hardly tells a turn about z:
where its standard error is too large for what it finds, that turn is left out.
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.log.check.candidates import KEYS, Candidate
from quadexp.log.signal.windows import UP, Pair, Windows, pairs

LEAST = 2.0  # deg: smaller turns are not reported
WARNS, MOST = 4.0, 20.0  # deg: more than the offsets of a fit absorb; the most of a mount that was never calibrated
LARGEST = 120.0  # deg: beyond, it is a convention of axes, which other candidates name
CERTAIN, CERTAIN_ALONE = 3.0, 5.0  # standard errors; of a turn about z that an accelerometer alone shows
KEPT = 0.9  # of the windows: knocks are left out
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
    """The turn of the accelerometer, of the gyro, and of both together, where the flight tells one."""
    found = {pair.relation: pair for pair in pairs(windows)}
    if "force" not in found and "force (p)" in found:
        found["force"] = found["force (p)"]
    made = []
    for streams, (relations, cost, words) in SENSORS.items():
        known = [pair for relation in relations if (pair := found.get(relation)) is not None]
        estimated = estimate(known, len(windows.t)) if len(known) == len(relations) else None
        if estimated is not None:
            made.append(_candidate(streams, *estimated, cost, words))
    return made


def estimate(known: list[Pair], windows: int) -> tuple[Rotation, np.ndarray] | None:
    """The rotation of the found sides of these relations onto the expected ones, and the standard errors of the turn
    about x, y, z (deg); None where there is none."""
    alone = all(pair.relation != "rate" for pair in known)
    expected, found, stretch = [], [], []
    for pair in known:
        if pair.relation == "rate" and np.sqrt(np.mean(np.sum(pair.expected**2, axis=1))) < LEAST_MOTION * pair.floor:
            return None
        size = np.linalg.norm(pair.expected - _kabsch(pair.expected, pair.found).apply(pair.found), axis=1)
        near = size <= np.quantile(size, KEPT)
        expected.append(pair.expected[near] / pair.floor)
        found.append(pair.found[near] / pair.floor)
        stretch.append((np.arange(len(pair.found)) % windows * STRETCHES // windows)[near])
    x, y, part = np.concatenate(expected), np.concatenate(found), np.concatenate(stretch)
    if len(x) < 3 * STRETCHES or not (np.isfinite(x).all() and np.isfinite(y).all()):
        return None
    turn = _kabsch(x, y)
    rest = [_kabsch(x[part != k], y[part != k]) for k in np.unique(part)]
    apart = np.array([(one * turn.inv()).as_rotvec() for one in rest])
    error = np.degrees(np.sqrt((len(rest) - 1) * np.var(apart, axis=0)))  # jackknife
    about_z = abs(np.degrees(turn.as_rotvec()[2]))
    if alone and (about_z < CERTAIN_ALONE * error[2] or error[2] > LEAST):
        turn = _shortest(turn)
    size = float(np.linalg.norm(error[:2] if alone else error))
    return (turn, error) if max(LEAST, CERTAIN * size) <= np.degrees(turn.magnitude()) < LARGEST else None


def _kabsch(x: np.ndarray, y: np.ndarray) -> Rotation:
    """The rotation that brings y (n, 3) onto x (n, 3)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "not uniquely defined": its error will be large
        return Rotation.align_vectors(x, y)[0]


def _shortest(turn: Rotation) -> Rotation:
    """The shortest of the turns that bring the same direction of the sensor onto the body's z."""
    up = turn.inv().apply(UP)
    axis = np.cross(up, UP)
    sine = float(np.linalg.norm(axis))
    return Rotation.from_rotvec(np.arctan2(sine, up[2]) * axis / sine) if sine > 1e-9 else Rotation.identity()


def _candidate(streams: str, turn: Rotation, error: np.ndarray, cost: float, words: str) -> Candidate:
    """The mounting undone. Turns by less than MOST do not block."""
    yaw, pitch, roll = turn.as_euler("ZYX", degrees=True)  # M = R_z(yaw) R_y(pitch) R_x(roll), as the mapping has it
    angles = [round(float(x), 2) + 0.0 for x in (roll, pitch, yaw)]
    size = float(np.degrees(turn.magnitude()))
    listed, errors = ", ".join(f"{x:g}" for x in angles), ", ".join(f"{e:.1f}" for e in error)
    text = f"{words} turned by {size:.1f} deg: roll, pitch, yaw {listed} deg (standard errors {errors})"
    severity = "info" if size < WARNS else "warning" if size <= MOST else "blocking"
    lines = {KEYS[name]: {"mounting": angles} for name in sorted(streams)}
    options = " ".join(f"{OPTIONS[name]}={listed.replace(' ', '')}" for name in sorted(streams))
    return Candidate("mounting", streams, text, lines, 2.5 if severity == "blocking" else cost, severity, options)
