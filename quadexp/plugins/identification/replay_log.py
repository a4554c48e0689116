"""What a replay takes of a log: the path that it flew, and the noise that a model leaves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class LoggedPath(NamedTuple):
    """The longest stretch of a log without a gap. t: (k,), s, from zero. position: (k, 3), m. target: (k, 3), its
    reference, None where the log has none. yaw: (k,), of the reference, else as flown (rad). rate: (k, 3), rad/s.
    rotors: thrusts per mass as commanded, (k, n), m/s^2. wind: mean speed (m/s), None where the log does not say."""

    t: np.ndarray
    position: np.ndarray
    target: np.ndarray | None
    yaw: np.ndarray
    rate: np.ndarray
    rotors: np.ndarray
    wind: float | None


class Noise(NamedTuple):
    """Spectral densities, N/sqrt(Hz) and N m/sqrt(Hz). shows_torque: whether the rotors' torque explains the turning
    better than none."""

    force: float
    torque: float
    shows_torque: bool
