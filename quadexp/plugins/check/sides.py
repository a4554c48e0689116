"""The two sides of what a gyro and an accelerometer tell: what the motion says, and what was read. A flight is cut into
stretches, whose scatter gives standard errors: the errors of a sensor last, so that neighbouring windows are alike.

Of a force, both are means over a window in the body as it turns, which a difference of velocities has the least noise
in:

    x = sum_k R_k^T (v_k+1 - v_k + g e_z dt) / T,     y = mean f
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from quadexp.physics.vehicle import GRAVITY
from quadexp.plugins.logs.signal.windows import UP, Windows, means, pairs, weighted

STRETCHES = 10  # of the flight, for standard errors


class Side(NamedTuple):
    """expected: what the motion says. read: by the sensor. Both (n, 3), n a multiple of the number of windows."""

    expected: np.ndarray
    read: np.ndarray


def stretches_of(rows: int, windows: int) -> np.ndarray:
    """The stretch of the flight, (rows,), that each row is of; rows: a multiple of the number of windows."""
    return np.arange(rows) % windows * STRETCHES // windows


def stretches(values: np.ndarray, windows: int) -> list[np.ndarray]:
    """Rows (n, ...) by stretch."""
    number = stretches_of(len(values), windows)
    return [values[number == k] for k in np.unique(number)]


def standard_error(values: np.ndarray) -> np.ndarray:
    """Of the mean of values (n, ...) of the stretches."""
    return values.std(axis=0, ddof=1) / np.sqrt(len(values))


def jackknife(estimate: Callable[[np.ndarray], np.ndarray | float], stretch: np.ndarray) -> np.ndarray:
    """Standard error of an estimate that is made from some of the rows, by a mask. stretch: number of each row's."""
    rest = np.array([estimate(stretch != k) for k in np.unique(stretch)])
    if len(rest) < 3:
        return np.full(rest.shape[1:], np.inf)
    return np.sqrt((len(rest) - 1) * np.var(rest, axis=0))


def sensor_sides(windows: Windows) -> dict[str, Side]:
    """Of gyro ("w") and accelerometer ("f"), in the body, where the motion tells them."""
    sides = {}
    for pair in pairs(windows, "w"):
        sides["w"] = Side(pair.expected, pair.measured)
    force = force_side(windows)
    if force is not None:
        sides["f"] = force
    return sides


def force_side(windows: Windows) -> Side | None:
    """Of an accelerometer by velocity, else by position, over whole windows; None where a stream is missing."""
    halves = force_of_halves(windows)
    if halves is not None:
        return whole(halves)
    for pair in pairs(windows, "f"):
        if pair.name == "force (p)":
            return Side(pair.expected, pair.measured)
    return None


def force_of_halves(windows: Windows) -> Side | None:
    """Of an accelerometer, of the first halves of the windows, then of the second, (2n, 3); None where attitude,
    velocity or accelerometer is missing."""
    t = windows.t
    streams = windows.streams
    if not set("qvf") <= streams.keys():
        return None
    turn = windows.rotation
    middle = (turn[:, 1:] + turn[:, :-1]) / 2
    change = np.diff(streams["v"], axis=1) / np.diff(t, axis=1)[..., None] + GRAVITY * UP
    in_body = np.einsum("nlij,nli->nlj", middle, change)
    return Side(weighted(t, in_body), means(t, streams["f"]))


def whole(halves: Side) -> Side:
    """Means over whole windows, (n, 3), of those over their halves, (2n, 3), which are as long."""
    return Side(*(side.reshape(2, -1, 3).mean(axis=0) for side in halves))


def in_world(windows: Windows) -> Side | None:
    """What velocity or position and what the accelerometer say, both with g, in the world, (n, 3); None where a stream
    is missing."""
    side = force_side(windows)
    if side is None:
        return None
    turn = windows.rotation[:, windows.t.shape[1] // 2]
    return Side(*(np.einsum("nij,nj->ni", turn, x) for x in side))
