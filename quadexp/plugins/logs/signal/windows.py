"""The motion of a flight in short windows, where what one sensor integrates to must equal what another one shows.

Over a window of duration T (about 0.1 s), with means by the trapezoidal rule,

    velocity:      (p(t + T) - p(t)) / T            =  mean v                      world, m/s
    rate:          mean of log(R_k^T R_k+1) / dt    =  mean w                      body, rad/s
    force:         (v(t + T) - v(t)) / T + g e_z    =  mean R f                    turned into the body, m/s^2
    force (p):     (p(t + 2T) - 2 p(t + T) + p(t)) / T^2 + g e_z  =  mean R f, weighted by a triangle

None of them differentiates a noisy signal between neighbouring samples, both sides are averaged in the same way, and
each relation needs two streams only. Besides, rotors push along +z: an accelerometer's z is positive ("push"), and
where there is none, the body x and y components of R^T (a + g e_z) are small (drag only), its z component is positive
("thrust").
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from quadexp.log.schema import Flight
from quadexp.physics.vehicle import GRAVITY

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

WINDOW = 0.1  # s
MOST_WINDOWS = 400  # spread over the flight: more do not change a verdict
STREAMS = {
    "p": ("p_x", "p_y", "p_z"),
    "q": ("q_w", "q_x", "q_y", "q_z"),
    "v": ("v_x", "v_y", "v_z"),
    "w": ("w_x", "w_y", "w_z"),
    "f": ("acc_x", "acc_y", "acc_z"),
}


def streams_of(flight: Flight) -> dict[str, np.ndarray]:
    """The streams that a flight has, by letter, (k, 3 or 4)."""
    there = {name: columns for name, columns in STREAMS.items() if set(columns) <= set(flight.columns)}
    return {name: flight.stack(columns).astype(float, copy=False) for name, columns in there.items()}


class Relation(NamedTuple):
    """streams: that it compares, by letter. floor: what clean logs differ by, root mean square over an axis. weight: of
    what it says, where another relation of the same streams says it too."""

    streams: str
    floor: float
    unit: str
    words: str
    weight: float = 1.0


# Floors: a motion capture of 0.1 mm and its filtered velocity, a hobby gyro's vibration averaged over a window, an
# attitude wrong by 2 degrees (0.35 m/s^2) and, without an accelerometer, the drag of a fast flight.
RELATIONS = {
    "velocity": Relation("pv", 0.02, "m/s", "v against dp/dt"),
    "rate": Relation("qw", 0.05, "rad/s", "w against the derivative of the attitude"),
    "push": Relation("f", 1.5, "m/s^2", "acc_z against thrust along +z"),
    "force": Relation("vqf", 0.3, "m/s^2", "acc against R^T (dv/dt + g)"),
    "force (p)": Relation("pqf", 0.3, "m/s^2", "acc against R^T (d2p/dt2 + g)", 0.5),
    "thrust": Relation("vq", 1.5, "m/s^2", "R^T (dv/dt + g) against thrust along +z"),
    "thrust (p)": Relation("pq", 1.5, "m/s^2", "R^T (d2p/dt2 + g) against thrust along +z", 0.5),
}
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Windows:
    """t: (n, 2m + 1) s. streams: p, q, v, w, f by letter, those that there are: (n, 2m + 1, 3 or 4), position,
    attitude, velocity, rate, specific force. A window is two halves of m steps each."""

    t: np.ndarray
    streams: Mapping[str, np.ndarray]

    @cached_property
    def rotation(self) -> np.ndarray:
        """R(q), (n, 2m + 1, 3, 3); where q is zero, the identity."""
        matrices = rotations(self.streams["q"]).as_matrix()
        return matrices.reshape(*self.t.shape, 3, 3)

    @cached_property
    def push(self) -> np.ndarray:
        """R f, (n, 2m + 1, 3) (m/s^2)."""
        return np.einsum("nlij,nlj->nli", self.rotation, self.streams["f"])

    def every(self, step: int) -> Windows:
        """Every step-th window."""
        streams = {name: values[::step] for name, values in self.streams.items()}
        return Windows(self.t[::step], streams)


class Pair(NamedTuple):
    """Two sides of one relation of RELATIONS, (n, 3) each: as others have it, and as its own sensor has it."""

    name: str
    expected: np.ndarray
    measured: np.ndarray

    @property
    def relation(self) -> Relation:
        return RELATIONS[self.name]


def cut(
    t: np.ndarray, streams: Mapping[str, np.ndarray], good: np.ndarray, segment: np.ndarray | None = None
) -> Windows:
    """Windows of streams (k, m) over times t (k,) without a gap in the clock, another segment or a bad sample."""
    samples = window_samples(t, good, segment)
    chosen = {name: streams[name][samples] for name in STREAMS if name in streams}
    return Windows(t[samples], chosen)


def window_samples(t: np.ndarray, good: np.ndarray, segment: np.ndarray | None = None) -> np.ndarray:
    """Which samples each window has, (n, 2m + 1)."""
    step = np.diff(t)
    onward = np.isfinite(step) & (step > 0)
    dt = float(np.median(step[onward])) if onward.any() else np.inf
    half = max(2, int(round(WINDOW / dt)))
    whole = onward & (step < 3.5 * dt) & good[1:] & good[:-1]
    if segment is not None:
        whole &= np.diff(segment) == 0
    breaks = np.concatenate([[0], np.cumsum(~whole)])
    first = np.arange(0, len(t) - 2 * half, half)
    last = first + 2 * half
    first = first[breaks[first] == breaks[last]]
    if len(first) > MOST_WINDOWS:
        spread = np.linspace(0, len(first) - 1, MOST_WINDOWS)
        first = first[spread.astype(int)]
    return first[:, None] + np.arange(2 * half + 1)


def pairs(windows: Windows, touching: str = "tpqvwf") -> list[Pair]:
    """Every relation that the streams at hand allow and that has one of the streams `touching`."""
    t = windows.t
    streams = windows.streams
    known = []

    def has(needed: str, relation: str) -> bool:
        wanted = "t" in touching or set(RELATIONS[relation].streams) & set(touching)
        return bool(wanted) and set(needed) <= streams.keys()

    if has("pv", "velocity"):
        known.append(Pair("velocity", changes(t, streams["p"]), means(t, streams["v"])))
    if has("qw", "rate"):
        turning = weighted(t, attitude_rate(t, streams["q"]))
        known.append(Pair("rate", turning, means(t, streams["w"])))
    if has("f", "push"):
        read = means(t, streams["f"])
        known.append(Pair("push", np.where(UP, np.abs(read), read), read))
    if has("vq", "force"):
        push = means(t, windows.push) if "f" in streams else None
        known.append(_forces("", middles(windows.rotation), changes(t, streams["v"]), push))
    if has("pq", "force (p)"):
        middle = t.shape[1] // 2
        first = (t[:, middle] - t[:, 0])[:, None]
        second = (t[:, -1] - t[:, middle])[:, None]
        before, after = np.split(changes(t, streams["p"]), 2)
        length = (first + second) / 2
        push = None
        if "f" in streams:
            since = t - t[:, middle, None]
            half = np.where(since < 0, first, second)
            triangle = np.maximum(0.0, 1 - np.abs(since) / half)
            weighed = windows.push * triangle[..., None]
            push = np.trapezoid(weighed, t[..., None], axis=1) / length
        known.append(_forces(" (p)", windows.rotation[:, middle], (after - before) / length, push))
    return known


def _forces(of: str, turn: np.ndarray, acceleration: np.ndarray, push: np.ndarray | None) -> Pair:
    """Force, or thrust where no accelerometer read a push: rotors push along +z, so that components beside +z have no
    counterpart. turn: R, (n, 3, 3). acceleration, push: world, (n, 3)."""
    expected = np.einsum("nij,ni->nj", turn, acceleration + GRAVITY * UP)
    if push is None:
        return Pair(f"thrust{of}", expected, np.abs(expected) * UP)
    return Pair(f"force{of}", expected, np.einsum("nij,ni->nj", turn, push))


def both(x: np.ndarray) -> np.ndarray:
    """The first halves of windows x (n, 2m + 1, ...), then the second ones, (2n, m + 1, ...)."""
    middle = x.shape[1] // 2
    first = x[:, : middle + 1]
    return np.concatenate([first, x[:, middle:]])


def middles(x: np.ndarray) -> np.ndarray:
    """The samples of x (n, 2m + 1, ...) in the middle of both halves, (2n, ...)."""
    x = both(x)
    return x[:, (x.shape[1] - 1) // 2]


def changes(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Rates of change of x (n, l, m) over both halves of the windows, (2n, m)."""
    t = both(t)
    x = both(x)
    duration = t[:, -1] - t[:, 0]
    return (x[:, -1] - x[:, 0]) / duration[:, None]


def means(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Means of x (n, l, m) over both halves of the windows by the trapezoidal rule, (2n, m)."""
    return weighted(t, (x[:, 1:] + x[:, :-1]) / 2)


def weighted(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Means over both halves of what is given between the samples, (n, l - 1, m)."""
    steps = np.diff(both(t), axis=1)[..., None]
    x = np.concatenate(np.split(x, 2, axis=1))
    return np.sum(x * steps, axis=1) / np.sum(steps, axis=1)


def rotations(q: np.ndarray) -> Rotation:
    """R(q) of q (..., 4), w first, one after the other; where q is zero, the identity."""
    from scipy.spatial.transform import Rotation

    q = q.reshape(-1, 4)
    is_zero = ~q.any(axis=1, keepdims=True)
    q = np.where(is_zero, [1.0, 0.0, 0.0, 0.0], q)
    return Rotation.from_quat(q, scalar_first=True)


def attitude_rate(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Body rate between neighbouring samples of an attitude, (..., l - 1, 3) (rad/s), of t (..., l), q (..., l, 4)."""
    before = rotations(q[..., :-1, :])
    after = rotations(q[..., 1:, :])
    turn = (before.inv() * after).as_rotvec()
    step = np.diff(t, axis=-1)[..., None]
    return turn.reshape(*step.shape[:-1], 3) / step
