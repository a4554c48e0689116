"""Which way is up in a log without accelerometer: the thrust keeps to one axis of the body, a + g e = R T / m.

Of all directions e of up, the one under which least of the acceleration lies beside one axis of the body is taken.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadexp.log.importers.evidence import UPS, Samples
from quadexp.log.importers.proposal import Groups
from quadexp.physics.vehicle import GRAVITY

UNLIKELY = 0.5  # a velocity in the body frame has to fit that much better than one in the world
DOUBTFUL = 1.8  # a gap between fits up to which the better one is likely, not sure
LEAST_MOTION = 0.5  # m/s^2 rms: a flight that says by its thrust alone which way is up


class Thrust(NamedTuple):
    """Without an accelerometer: the thrust points along one axis of the body. misfit: what lies beside it, over the
    acceleration. gap: misfit of the next best choice over this one. in_body: whether the velocity is in the body."""

    up: str
    axis: str
    misfit: float
    gap: float
    in_body: bool


def thrust_alone(R: np.ndarray, s: Samples, said: Groups) -> Thrust | None:
    """Which way is up and along which axis of the body the thrust points, from the motion and the attitude alone.

    R: (n, 3, 3), log's body to log's world. None where nothing is known of the motion, or too little moves.
    """
    motion, columns = acceleration_of_motion(s, said)
    if columns is None:
        return None
    motions = [(False, motion)]
    if columns in said.get("velocity", []):  # its name does not say whether it is in the world or in the body
        motions.append((True, s.rate_of(np.einsum("nij,nj->ni", R, s.x[:, columns]))))
    made = [found for in_body, a in motions if (found := _best_thrust(R, a, in_body)) is not None]
    if len(made) < len(motions):
        return None
    world, body = made[0], made[-1]
    chosen = body if body.misfit < UNLIKELY * world.misfit else world
    return chosen._replace(gap=min(chosen.gap, DOUBTFUL)) if len(made) > 1 else chosen


def _best_thrust(R: np.ndarray, motion: np.ndarray, in_body: bool) -> Thrust | None:
    """The direction of up under which the thrust keeps to one axis of the body; None where too little moves."""
    size = float(np.sqrt(np.mean(np.sum(motion**2, axis=1))))
    if not LEAST_MOTION < size < 10 * GRAVITY:
        return None
    found = []
    for up, direction in UPS.items():
        force = np.einsum("nji,nj->ni", R, motion + GRAVITY * np.array(direction))
        mean = force.mean(axis=0)
        axis = int(np.argmax(np.abs(mean)))
        beside = force**2
        beside[:, axis] = np.minimum(0.0, np.sign(mean[axis]) * force[:, axis]) ** 2
        misfit = float(np.sqrt(np.mean(beside.sum(axis=1)))) / size
        found.append((misfit, up, ("-" if mean[axis] < 0 else "") + "xyz"[axis]))
    (best, up, name), (second, *_) = sorted(found)[:2]
    return Thrust(up, name, best, second / max(best, 1e-6), in_body)


def acceleration_of_motion(s: Samples, said: Groups) -> tuple[np.ndarray, list[int] | None]:
    """Acceleration in the log's world, (n, 3) (m/s^2), from a named velocity or position, and its columns.

    Zeros and None where neither is named: then gravity alone has to explain the accelerometer.
    """
    for columns in said.get("velocity", []):
        return s.dx[:, columns], columns
    for columns in said.get("position", []):
        return s.smooth(s.rate_of(s.dx[:, columns])), columns
    return np.zeros((len(s.t), 3)), None
