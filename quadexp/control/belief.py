"""What an observer believes of the world around the vehicle, beside the controller's model.

    m v' = s T R e_z + c F_air(v - w, ..) + m g + F,    J w' = .. + c tau_air + tau

F, tau: disturbance; w: wind; s: thrust scale, what a rotor delivers of a commanded newton; c: air scale, what the air
does of what the model says. A controller that can use it
has a method `believe(belief)`, called before each `step`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

N_BELIEF = 11  # numbers, in the order of Belief


class Belief(NamedTuple):
    """force: (3,), world (N). torque: (3,), body (N m). wind: velocity of the air (3,), world (m/s). thrust_scale,
    air_scale: 1 is as the model."""

    force: np.ndarray
    torque: np.ndarray
    wind: np.ndarray
    thrust_scale: float = 1.0
    air_scale: float = 1.0


def no_belief() -> Belief:
    """The world is as the model: still air, nothing beyond it."""
    return Belief(np.zeros(3), np.zeros(3), np.zeros(3))
