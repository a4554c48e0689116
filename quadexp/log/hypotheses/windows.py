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

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadexp.physics.vehicle import GRAVITY

WINDOW = 0.1  # s
MOST_WINDOWS = 400  # spread over the flight: more do not change a verdict
STREAMS = {
    "p": ("p_x", "p_y", "p_z"),
    "q": ("q_w", "q_x", "q_y", "q_z"),
    "v": ("v_x", "v_y", "v_z"),
    "w": ("w_x", "w_y", "w_z"),
    "f": ("acc_x", "acc_y", "acc_z"),
}
# The streams that a relation compares.
SIDES = {
    "velocity": "pv", "rate": "qw", "push": "f", "force": "vqf", "force (p)": "pqf", "thrust": "vq", "thrust (p)": "pq",
}  # fmt: skip
# What clean logs differ by, root mean square over an axis: a motion capture of 0.1 mm and its filtered velocity, a
# hobby gyro's vibration averaged over a window, an attitude wrong by 2 degrees (0.35 m/s^2) and, without an
# accelerometer, the drag of a fast flight.
FLOOR = {"velocity": 0.02, "rate": 0.05, "force": 0.3, "force (p)": 0.3, "thrust": 1.5}
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Windows:
    """t: (n, 2m + 1) s. p, q, v, w, f: (n, 2m + 1, .) or None: position, attitude, velocity, rate, specific force.

    A window is two halves of m steps each. rotation: (n, 2m + 1, 3, 3), R(q), or None.
    """

    t: np.ndarray
    p: np.ndarray | None = None
    q: np.ndarray | None = None
    v: np.ndarray | None = None
    w: np.ndarray | None = None
    f: np.ndarray | None = None
    rotation: np.ndarray | None = None

    @classmethod
    def of_streams(cls, t: np.ndarray, streams: dict[str, np.ndarray]) -> Windows:
        """t: (n, l). streams: (n, l, .) by letter."""
        rotation = rotation_matrices(streams["q"]) if "q" in streams else None
        return cls(t=t, **streams, rotation=rotation)

    def of(self, name: str) -> np.ndarray:
        """A stream, or the rotation, that the caller knows to be there."""
        values: np.ndarray | None = getattr(self, name)
        if values is None:
            raise ValueError(f"these windows have no {name}")
        return values

    def every(self, step: int) -> Windows:
        """Every step-th window."""
        found = {name: getattr(self, name) for name in ("t", *STREAMS, "rotation")}
        kept: dict[str, Any] = {name: None if x is None else x[::step] for name, x in found.items()}
        return Windows(**kept)

    def having(self, **changes: Any) -> Windows:
        """A copy with some streams replaced; R(q) follows q."""
        if "q" in changes:
            changes["rotation"] = rotation_matrices(changes["q"])
        return replace(self, **changes)


@dataclass(frozen=True)
class Pair:
    """Two sides of one relation. expected, found: (n, 3). floor: what sensors of this kind may differ by."""

    relation: str
    expected: np.ndarray
    found: np.ndarray
    floor: float


def cut(t: np.ndarray, streams: dict[str, np.ndarray], starts: np.ndarray, half: int) -> Windows:
    """Windows of 2 half + 1 samples that begin at the samples `starts`."""
    samples = starts[:, None] + np.arange(2 * half + 1)
    return Windows.of_streams(t[samples], {name: streams[name][samples] for name in STREAMS if name in streams})


def window_starts(t: np.ndarray, good: np.ndarray, segment: np.ndarray | None = None) -> tuple[np.ndarray, int]:
    """First samples of windows without a gap in the clock or a bad sample, and the steps in half a window."""
    step = np.diff(t)
    positive = step[np.isfinite(step) & (step > 0)]
    if not len(positive):
        return np.empty(0, int), 2
    dt = float(np.median(positive))
    half = max(2, int(round(WINDOW / dt)))
    broken = ~(np.isfinite(step) & (step > 0) & (step < 3.5 * dt)) | ~good[1:] | ~good[:-1]
    if segment is not None:
        broken |= np.diff(segment) != 0
    bad = np.concatenate([[0], np.cumsum(broken)])
    first = np.arange(0, len(t) - 2 * half, half)
    first = first[bad[first] == bad[first + 2 * half]]
    if len(first) > MOST_WINDOWS:
        first = first[np.linspace(0, len(first) - 1, MOST_WINDOWS).astype(int)]
    return first, half


def halves(t: np.ndarray) -> tuple[tuple[int, int], tuple[int, int]]:
    """First and last sample of both halves of windows t (n, 2m + 1)."""
    half = t.shape[1] // 2
    return (0, half), (half, 2 * half)


def means(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Means of x (n, l, m) over both halves of the windows by the trapezoidal rule, (2n, m)."""
    return np.concatenate([mean(t, x, a, b) for a, b in halves(t)])


def changes(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Rates of change of x (n, l, m) over both halves of the windows, (2n, m)."""
    return np.concatenate([(x[:, b] - x[:, a]) / (t[:, b] - t[:, a])[:, None] for a, b in halves(t)])


def body_rate(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Means of the body rate that an attitude q (n, l, 4) has over both halves of the windows, (2n, 3) (rad/s)."""
    return _weighted(t, attitude_rate(t, q))


def _weighted(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Means over both halves of what is given between the samples, (n, l - 1, 3)."""
    weight = np.diff(t, axis=1)[..., None]
    parts = [slice(a, b) for a, b in halves(t)]
    return np.concatenate([np.sum(x[:, s] * weight[:, s], axis=1) / np.sum(weight[:, s], axis=1) for s in parts])


def pairs(windows: Windows, up: np.ndarray = UP, touching: str = "tpqvwf") -> list[Pair]:
    """Every relation that the streams at hand allow and that has one of the streams `touching`.

    up: direction of up in the world, (3,).
    """
    one = windows

    def wanted(relation: str) -> bool:
        return "t" in touching or bool(set(SIDES[relation]) & set(touching))

    half = one.t.shape[1] // 2
    found = []
    if one.p is not None and one.v is not None and wanted("velocity"):
        found.append(Pair("velocity", changes(one.t, one.p), means(one.t, one.v), FLOOR["velocity"]))
    if one.q is not None and one.w is not None and wanted("rate"):
        middle = (one.w[:, 1:] + one.w[:, :-1]) / 2
        found.append(Pair("rate", body_rate(one.t, one.q), _weighted(one.t, middle), FLOOR["rate"]))
    if one.f is not None and wanted("push"):
        read = means(one.t, one.f)
        found.append(Pair("push", np.abs(read) * UP + read * (1 - UP), read, FLOOR["thrust"]))
    if one.q is None or (one.v is None and one.p is None) or not set(touching) & set("tpvqf"):
        return found
    push = None if one.f is None else np.einsum("nlij,nlj->nli", one.of("rotation"), one.f)
    if one.v is not None and wanted("force"):
        change = changes(one.t, one.v) + GRAVITY * up
        turn = np.concatenate([one.of("rotation")[:, (a + b) // 2] for a, b in halves(one.t)])
        expected = np.einsum("nij,ni->nj", turn, change)
        if push is None:
            found.append(_thrust("thrust", expected))
        else:
            seen = means(one.t, push)
            found.append(Pair("force", expected, np.einsum("nij,ni->nj", turn, seen), FLOOR["force"]))
    if one.p is not None and wanted("force (p)"):
        first, second = ((one.t[:, b] - one.t[:, a])[:, None] for a, b in halves(one.t))
        change = (one.p[:, -1] - one.p[:, half]) / second - (one.p[:, half] - one.p[:, 0]) / first
        change = change / ((first + second) / 2) + GRAVITY * up
        turn = one.of("rotation")[:, half]
        expected = np.einsum("nij,ni->nj", turn, change)
        if push is None:
            found.append(_thrust("thrust (p)", expected))
        else:
            since = one.t - one.t[:, half : half + 1]
            triangle = np.maximum(0.0, 1 - np.abs(since) / np.where(since < 0, first, second))[..., None]
            seen = np.trapezoid(push * triangle, one.t[..., None], axis=1) / ((first + second) / 2)
            found.append(Pair("force (p)", expected, np.einsum("nij,ni->nj", turn, seen), FLOOR["force (p)"]))
    return found


def _thrust(relation: str, expected: np.ndarray) -> Pair:
    """Rotors push along +z: components beside +z or below zero have no counterpart on the found side."""
    along = np.stack([0 * expected[:, 0], 0 * expected[:, 1], np.abs(expected[:, 2])], axis=-1)
    return Pair(relation, expected, along, FLOOR["thrust"])


def mean(t: np.ndarray, x: np.ndarray, a: int, b: int) -> np.ndarray:
    """Mean of x (n, l, m) from sample a to b by the trapezoidal rule, (n, m)."""
    step = np.diff(t[:, a : b + 1], axis=1)
    weight = np.zeros((len(t), b - a + 1))
    weight[:, :-1] += step
    weight[:, 1:] += step
    return np.einsum("nl,nli->ni", weight / (2 * step.sum(axis=1, keepdims=True)), x[:, a : b + 1])


def rotation_matrices(q: np.ndarray) -> np.ndarray:
    """R(q) of quaternions (..., 4), w first, of any length, (..., 3, 3)."""
    w, x, y, z = np.moveaxis(q / np.maximum(np.linalg.norm(q, axis=-1, keepdims=True), 1e-12), -1, 0)
    matrix = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(line, axis=-1) for line in matrix], axis=-2)


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product of quaternions (..., 4), w first."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def attitude_rate(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Body rate between neighbouring samples of an attitude, (..., l - 1, 3) (rad/s), of t (..., l), q (..., l, 4)."""
    q = q / np.maximum(np.linalg.norm(q, axis=-1, keepdims=True), 1e-12)
    turn = multiply(q[..., :-1, :] * np.array([1, -1, -1, -1]), q[..., 1:, :])
    turn = turn * np.where(turn[..., :1] < 0, -1, 1)
    sine = np.linalg.norm(turn[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, turn[..., :1])
    scale = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 2.0)
    return scale * turn[..., 1:] / np.diff(t, axis=-1)[..., None]
