"""Samples of the blade-element model, computed by tests.paper: body velocity, rotor speeds, specific force."""

from typing import NamedTuple

import numpy as np

from tests import paper


class AirData(NamedTuple):
    """t (k,) s; velocity (k, 3) m/s, rotor_speed (k, 4) rad/s, specific_force (k, 3) m/s^2: FLU, without noise."""

    t: np.ndarray
    velocity: np.ndarray
    rotor_speed: np.ndarray
    specific_force: np.ndarray


def air_data(samples: int = 400, *, period: float = 0.05) -> AirData:
    """A lively flight: both horizontal directions, climb and descent, uneven rotors."""
    t = period * np.arange(samples)
    velocity = np.stack([6 * np.sin(0.9 * t), 5 * np.cos(0.7 * t), 2 * np.sin(1.3 * t)], axis=-1)
    rotor_speed = 527 + 60 * np.sin(2 * t[:, None] + np.arange(4))
    force = [paper.point(paper.flip(v), w).F / paper.M for v, w in zip(velocity, rotor_speed, strict=True)]
    return AirData(t, velocity, rotor_speed, paper.flip(np.array(force)))
