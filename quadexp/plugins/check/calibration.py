"""Calibrations of one sensor that a flight tells, each with its standard error: a bias, a turn, both, a heading.

    x_k = M y_k - b + noise         M: in SO(3), x_k: what the motion says over a window, y_k: what the sensor read

A turn alone is that of Wahba (1965), by Kabsch (1976). A specific force points along the body's z nearly always, so
that a turn by a small angle and a bias of g times the angle look alike; what tells them apart is that the force varies:
M by the variations alone (both sides less their means), then b by the means. For the same reason an accelerometer alone
hardly tells a turn about z: where its standard error is too large for what it finds, that turn is left out.

Two explanations are compared stretch by stretch of the flight, by the difference of their squared residuals, less their
means, and its own standard error (Vuong 1989); where that is less than CLEAR, both are named. The means do not count:
every sensor has a small bias beside what is looked for. Other standard errors are those of a jackknife over stretches.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.physics.state import norms, root_mean_square
from quadexp.plugins.check.candidates import KEYS, Candidate
from quadexp.plugins.check.sides import Side, in_world, jackknife, sensor_sides, standard_error, stretches, stretches_of
from quadexp.plugins.logs.signal.windows import RELATIONS, UP, Windows

# Of a bias, by stream: the least that is named, the largest that a sensor has, unit.
BIAS = {"w": (0.03, 1.0, "rad/s"), "f": (0.5, 3.0, "m/s^2")}
SURE = 5.0  # standard errors
LEAST_YAW = 2.0  # deg
YAW_BLOCKS = 8.0  # deg
LEAST_TURN = 2.0  # deg: smaller turns are not reported
TURN_WARNS = 4.0  # deg: more than the offsets of a fit absorb
MOST_TURN = 20.0  # deg: of a mount that was never calibrated
LARGEST_TURN = 120.0  # deg: beyond, it is a convention of axes, which other candidates name
CERTAIN = 3.0  # standard errors
CERTAIN_ALONE = 5.0  # standard errors, of a turn about z that an accelerometer alone shows
KEPT = 0.9  # share of the windows: knocks are left out
LEAST_ROWS = 30  # of a turn: three a stretch
LEAST_MOTION = 2.0  # floors that a gyro must turn by to tell how it sits
CLEAR = 3.5  # standard errors of a difference of squared residuals
# Streams that are turned together: cost, words.
SENSORS = {"f": (0.5, "the accelerometer is"), "w": (0.5, "the gyro is"), "wf": (0.6, "accelerometer and gyro are")}
COST_BLOCKS = 2.5  # of a turn that blocks; see Candidate.cost
COST_BIASED = 1.9  # of a turn with a bias
OPTIONS = {"f": "--mounting", "w": "--gyro-mounting"}  # of the import
FLOORS = {"w": RELATIONS["rate"].floor, "f": RELATIONS["force"].floor}


# ----------------------------------------------------------------------------------------------------- bias and heading
def bias_candidates(windows: Windows) -> list[Candidate]:
    """A constant that a gyro or an accelerometer adds, where the flight shows one."""
    candidates = []
    for stream, side in sensor_sides(windows).items():
        offset, text = _bias(stream, side.read - side.expected, len(windows.t))
        if offset is not None:
            lines = {KEYS[stream]: {"offset": offset}}
            candidates.append(Candidate("bias", stream, f"a bias of {text}", lines, 1.7, "warning"))
    return candidates


def _bias(stream: str, gap: np.ndarray, windows: int) -> tuple[list[float] | None, str]:
    """The constant in gaps (n, 3), and in words; None for what no sensor has: too small, unsure, or too large."""
    medians = np.array([np.median(part, axis=0) for part in stretches(gap, windows)])
    if len(medians) < 3:
        return None, ""
    bias = np.median(gap, axis=0)
    bias = np.where(np.abs(bias) > SURE * standard_error(medians), bias, 0.0)
    least, most, unit = BIAS[stream]
    if not least <= np.abs(bias).max() <= most:
        return None, ""
    offset = [float(f"{x:.3g}") + 0.0 for x in bias]
    return offset, f"{', '.join(f'{x:g}' for x in offset)} {unit}"


def heading_candidates(windows: Windows) -> list[Candidate]:
    """A heading of the attitude that is turned about the vertical against position and velocity:

    min over psi of sum_k |a_k - R_z(psi) R_k f_k|^2,  horizontal components.
    """
    side = in_world(windows)
    if side is None:
        return []
    a = side.expected - side.expected.mean(axis=0)
    f = side.read - side.read.mean(axis=0)
    cross = f[:, 0] * a[:, 1] - f[:, 1] * a[:, 0]
    dot = np.sum(f[:, :2] * a[:, :2], axis=1)

    def angle(rows: np.ndarray | slice) -> float:
        return float(np.degrees(np.arctan2(cross[rows].sum(), dot[rows].sum())))

    yaw = angle(slice(None))
    stretch = stretches_of(len(a), len(windows.t))
    error = float(jackknife(lambda rows: (angle(rows) - yaw + 180) % 360, stretch))
    if abs(yaw) < max(LEAST_YAW, SURE * error):
        return []
    text = f"the heading is turned by {-yaw:.1f} deg (standard error {error:.1f}) against the motion"
    severity = "blocking" if abs(yaw) > YAW_BLOCKS else "warning"
    return [Candidate("heading", "q", text, {"attitude": {"turn": round(yaw, 2)}}, 1.3, severity)]


# ---------------------------------------------------------------------------------------------------------------- turns
def mounting_candidates(windows: Windows) -> list[Candidate]:
    """The turn of the accelerometer, of the gyro, and of both together, where the flight tells one; and such a turn
    with a bias."""
    known = {}
    for name, side in sensor_sides(windows).items():
        moves = root_mean_square(side.expected) * np.sqrt(3) > LEAST_MOTION * FLOORS[name]
        if moves and np.isfinite(side).all():
            known[name] = side
    candidates = []
    for streams in SENSORS:
        if set(streams) <= known.keys():
            sides = {name: known[name] for name in streams}
            for biased in (False, True):
                candidates += _mounting(streams, sides, len(windows.t), biased=biased)
    return candidates


def _mounting(streams: str, sides: dict[str, Side], windows: int, *, biased: bool) -> list[Candidate]:
    """The turn of these streams, none where it is not certain. biased: with a bias, none where there is no bias."""
    scaled = []
    for name, side in sides.items():
        if biased:
            side = Side(side.expected - side.expected.mean(axis=0), side.read - side.read.mean(axis=0))
        scaled.append(Side(side.expected / FLOORS[name], side.read / FLOORS[name]))
    turn, error = turn_of(scaled, windows, alone=streams == "f")
    if turn is None:
        return []
    yaw, pitch, roll = turn.as_euler("ZYX", degrees=True)  # M = R_z(yaw) R_y(pitch) R_x(roll), as the mapping has it
    angles = [round(float(angle), 2) + 0.0 for angle in (roll, pitch, yaw)]
    size = float(np.degrees(turn.magnitude()))
    listed = ", ".join(f"{angle:g}" for angle in angles)
    errors = ", ".join(f"{e:.1f}" for e in error)
    cost, words = SENSORS[streams]
    text = f"{words} turned by {size:.1f} deg: roll, pitch, yaw {listed} deg (standard errors {errors})"
    lines: dict[str, Any] = {KEYS[name]: {"mounting": angles} for name in sorted(streams)}
    severity = "warning"
    if size > MOST_TURN:
        severity = "blocking"
    if not biased:
        if severity == "blocking":
            cost = COST_BLOCKS
        elif size < TURN_WARNS:
            severity = "info"
        value = listed.replace(" ", "")
        options = " ".join(f"{OPTIONS[name]}={value}" for name in sorted(streams))
        return [Candidate("mounting", streams, text, lines, cost, severity, options)]
    biases = []
    for name, side in sides.items():
        gap = turn.apply(side.read) - side.expected
        offset, bias = _bias(name, gap, windows)
        _, most, _ = BIAS[name]
        if np.abs(np.median(gap, axis=0)).max() > most:  # it is another fault that looks like one
            return []
        if offset is not None:
            lines[KEYS[name]]["offset"] = offset
            biases.append(bias)
    if not biases:
        return []
    text += f", with a bias of {' and '.join(biases)}"
    return [Candidate("mounting", streams, text, lines, COST_BIASED, severity)]


def turn_of(sides: list[Side], windows: int, *, alone: bool) -> tuple[Rotation | None, np.ndarray]:
    """The rotation of what was read onto what the motion says, None where there is none for certain, and its standard
    errors about x, y, z (deg). sides: in floors. alone: of an accelerometer, which may not tell a turn about z."""
    parts = []
    for x, y in sides:
        size = norms(x - kabsch(x, y).apply(y))
        near = size <= np.quantile(size, KEPT)
        parts.append((x[near], y[near], stretches_of(len(x), windows)[near]))
    x, y, stretch = (np.concatenate(part) for part in zip(*parts, strict=True))
    turn = kabsch(x, y)
    inverse = turn.inv()
    error = np.degrees(jackknife(lambda rows: (kabsch(x[rows], y[rows]) * inverse).as_rotvec(), stretch))
    if alone:
        about_z = abs(np.degrees(turn.as_rotvec()[2]))
        if about_z < CERTAIN_ALONE * error[2] or error[2] > LEAST_TURN:
            turn = shortest(turn)
    spread = np.linalg.norm(error[:2] if alone else error)
    certain = max(LEAST_TURN, CERTAIN * spread) <= np.degrees(turn.magnitude()) < LARGEST_TURN
    if not certain or len(x) < LEAST_ROWS:
        return None, error
    return turn, error


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
    if sine < 1e-9:
        return Rotation.identity()
    return Rotation.from_rotvec(np.arctan2(sine, up[2]) * axis / sine)


# ------------------------------------------------------------------------------------------------------------ which one
def better(a: Windows, b: Windows, streams: str) -> float:
    """By how many standard errors the variations of these streams agree better in windows `a` than in `b`."""
    sides_a = sensor_sides(a)
    sides_b = sensor_sides(b)
    gains = []
    for name in set(streams) & sides_a.keys() & sides_b.keys():
        of_a = _squares(sides_a[name], FLOORS[name])
        of_b = _squares(sides_b[name], FLOORS[name])
        kept = (of_a <= np.quantile(of_a, KEPT)) & (of_b <= np.quantile(of_b, KEPT))
        gained = np.where(kept, of_b - of_a, 0.0)
        gains.append([part.mean() for part in stretches(gained, len(a.t))])
    total = np.sum(gains, axis=0)
    if np.size(total) < 3:
        return 0.0
    return float(total.mean() / max(standard_error(total), 1e-12))


def _squares(side: Side, floor: float) -> np.ndarray:
    """Squared gaps (n,), less their median, in floors."""
    gap = side.read - side.expected
    return np.sum((gap - np.median(gap, axis=0)) ** 2, axis=1) / floor**2
