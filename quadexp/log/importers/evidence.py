"""What the data says of a table's columns: rates from an attitude, specific force from motion, which signed permutation
of axes fits.

    body rate            2 vec(q* q')
    specific force       R^T (a + g e),  e the direction of up in the log's world
    fit of a frame S     correlation of S x with y, over the 24 rotations that map axes to axes
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import permutations, product

import numpy as np

from quadexp.log.signal import continuous
from quadexp.physics.vehicle import GRAVITY

SMOOTH = 0.15  # s
RATE = 100.0  # Hz
MOST = 8000  # samples looked at


@dataclass
class Samples:
    """t: (n,) s (of a unit still to be checked). x: (n, N), smoothed. dx: its derivative (per unit of t)."""

    t: np.ndarray
    x: np.ndarray
    dx: np.ndarray
    width: int = 1

    def smooth(self, values: np.ndarray) -> np.ndarray:
        return smooth(values, self.width)

    def rate_of(self, values: np.ndarray) -> np.ndarray:
        return np.gradient(values, self.t, axis=0)


def sample(t: np.ndarray, columns: np.ndarray) -> Samples:
    """The middle of a log on a uniform clock, smoothed; empty cells are bridged."""
    later = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]])
    t, columns = t[later], columns[later]
    period = max(float(np.median(np.diff(t))), 1 / RATE)
    length = min(t[-1] - t[0], MOST * period)
    start = 0.5 * (t[0] + t[-1] - length)
    grid = start + np.arange(int(length / period) + 1) * period
    width = max(1, int(round(SMOOTH / period)) | 1)
    x = np.empty((len(grid), columns.shape[1]))
    for i, column in enumerate(columns.T):
        good = np.isfinite(column)
        x[:, i] = np.interp(grid, t[good], column[good]) if good.sum() > 1 else np.nan
    x = smooth(x, width)
    return Samples(grid, x, np.asarray(np.gradient(x, grid, axis=0)), width)


def smooth(values: np.ndarray, width: int) -> np.ndarray:
    """Running mean over `width` samples, the ends held."""
    if width < 2:
        return values
    half = width // 2
    padded = np.pad(values, ((half + 1, half), (0, 0)), mode="edge")
    total = np.cumsum(padded, axis=0)
    return (total[width:] - total[:-width]) / width


def correlations(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Correlation of every column of a, (n, i), with every column of b, (n, j); 0 where one does not move."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    na, nb = np.sqrt((a * a).sum(axis=0)), np.sqrt((b * b).sum(axis=0))
    with np.errstate(invalid="ignore", divide="ignore"):
        found = (a.T @ b) / np.outer(na, nb)
    return np.nan_to_num(found)


@cache
def turns() -> tuple[np.ndarray, ...]:
    """The 24 rotations that map axes to axes, the identity first, then turns of fewest axes."""
    made = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            for row, (column, sign) in enumerate(zip(order, signs, strict=True)):
                matrix[row, column] = sign
            if np.linalg.det(matrix) > 0:
                made.append(matrix)
    return tuple(sorted(made, key=lambda m: -np.trace(m)))


def quaternion(x: np.ndarray, order: str, inverse: bool) -> np.ndarray:
    """Unit quaternion, (n, 4), w first, from four columns in `order`."""
    q = x[:, [order.index(axis) for axis in "wxyz"]]
    q = continuous(q / np.linalg.norm(q, axis=1, keepdims=True))
    return q * np.array([1.0, -1.0, -1.0, -1.0]) if inverse else q


def body_rate(q: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Body rate of a quaternion body to world, (n, 3) (rad per unit of t)."""
    w, x, y, z = q.T
    dw, dx, dy, dz = np.gradient(q, t, axis=0).T
    return 2 * np.stack(
        [w * dx - x * dw - y * dz + z * dy, w * dy - y * dw - z * dx + x * dz, w * dz - z * dw - x * dy + y * dx], 1
    )


@dataclass(frozen=True)
class Fit:
    """matrix: S with S x ~ y / scale. score: correlation over the three axes. scale: of y over S x."""

    matrix: np.ndarray
    score: float
    scale: float


PLAIN = 0.03  # by how much a turned frame has to fit better than the one not turned


def fit_turn(x: np.ndarray, y: np.ndarray, *, centred: bool = True) -> Fit:
    """The turn S, and scale, with which S x fits y best; both (n, 3). None is preferred to one that fits little better.

    centred: whether means are taken off (an offset of a gyro), or part of the fit (gravity). The score is
    <S x, y> / (|x| |y|).
    """
    if centred:
        x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    cross = y.T @ x
    nx, ny = float(np.sqrt((x * x).sum())), float(np.sqrt((y * y).sum()))
    if nx == 0 or ny == 0:
        return Fit(np.eye(3), 0.0, 1.0)
    scores = [float((s * cross).sum()) / (nx * ny) for s in turns()]
    best = int(np.argmax(scores))
    if scores[best] < scores[0] + PLAIN:
        best = 0
    return Fit(turns()[best], scores[best], scores[best] * ny / nx)


UPS = {"z": (0, 0, 1.0), "-z": (0, 0, -1.0), "y": (0, 1.0, 0), "-y": (0, -1.0, 0), "x": (1.0, 0, 0), "-x": (-1.0, 0, 0)}


def fit_force(R: np.ndarray, acceleration: np.ndarray, force: np.ndarray) -> tuple[str, Fit, float]:
    """Which way is up, and how the accelerometer's axes stand in the attitude's body frame.

    R: (n, 3, 3) of the hypothesis. acceleration: (n, 3), of the motion, in the log's world (m/s^2). force: (n, 3) raw.
    Returns up, the fit, and by how much the next best up fits worse.
    """
    fits = {}
    for name, up in UPS.items():
        expected = np.einsum("nji,nj->ni", R, acceleration + GRAVITY * np.array(up))
        fits[name] = fit_turn(force, expected, centred=False)
    # The same axes as the attitude's, unless they do not explain gravity.
    plain = [name for name in fits if (fits[name].matrix == np.eye(3)).all() and fits[name].score > 0.9]
    ranked = sorted(plain or fits, key=lambda name: -fits[name].score)
    if len(ranked) == 1:
        return ranked[0], fits[ranked[0]], 1.0
    return ranked[0], fits[ranked[0]], fits[ranked[0]].score - fits[ranked[1]].score


def is_unit(x: np.ndarray) -> bool:
    """Whether four columns, (n, 4), are a unit quaternion; smoothing shortens it where it turns fast or flips."""
    if not np.isfinite(x).all():
        return False
    norm = np.sqrt((x * x).sum(axis=1))
    return bool(np.quantile(np.abs(norm - 1), 0.9) < 0.02 and norm.min() > 1e-3 and np.ptp(x, axis=0).max() > 1e-3)


def matrices(q: np.ndarray) -> np.ndarray:
    """Rotation matrices, (n, 3, 3), body to world, of quaternions (n, 4), w first."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(q, scalar_first=True).as_matrix()
