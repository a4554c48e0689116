"""An error-state EKF once more, in plain numpy: rotations by scipy, every derivative by differences, joint updates in
Joseph's form. It shares no line with quadexp/plugins/worlds/eskf.py."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

SMALL = 1e-6
Nominal = tuple[np.ndarray, np.ndarray, Rotation, np.ndarray, np.ndarray]  # p, v, attitude, b_a, b_g


def unpack(nominal: np.ndarray) -> Nominal:
    attitude = Rotation.from_quat(nominal[3:7], scalar_first=True)
    return nominal[:3], nominal[7:10], attitude, nominal[10:13], nominal[13:]


def moved(s: Nominal, d: np.ndarray) -> Nominal:
    return s[0] + d[:3], s[1] + d[3:6], s[2] * Rotation.from_rotvec(d[6:9]), s[3] + d[9:12], s[4] + d[12:]


def apart(one: Nominal, other: Nominal) -> np.ndarray:
    """d with other = one moved by d."""
    turned = (one[2].inv() * other[2]).as_rotvec()
    return np.concatenate([other[0] - one[0], other[1] - one[1], turned, other[3] - one[3], other[4] - one[4]])


def pushed(s: Nominal, reading: np.ndarray, h: float, gravity: float) -> Nominal:
    p, v, R, b_a, b_g = s
    turn = (reading[3:] - b_g) * h
    gain = (R * Rotation.from_rotvec(turn / 2)).apply(reading[:3] - b_a) * h - np.array([0, 0, gravity * h])
    return p + v * h + gain * h / 2, v + gain, R * Rotation.from_rotvec(turn), b_a, b_g


def differences(f: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    return np.column_stack([(f(SMALL * e) - f(-SMALL * e)) / (2 * SMALL) for e in np.eye(15)])


def predict(s: Nominal, P: np.ndarray, reading, h: float, gravity: float, densities) -> tuple[Nominal, np.ndarray]:
    after = pushed(s, reading, h, gravity)
    F = differences(lambda d: apart(after, pushed(moved(s, d), reading, h, gravity)))
    G = np.zeros((15, 12))  # of the velocity gained, the turn, and the steps of the biases
    G[:3, :3], G[3:6, :3], G[6:, 3:] = h / 2 * np.eye(3), np.eye(3), np.eye(9)
    return after, F @ P @ F.T + G @ np.diag(np.repeat(np.square(densities) * h, 3)) @ G.T


def update(s: Nominal, P: np.ndarray, innovation: Callable[[Nominal], np.ndarray], R) -> tuple[Nominal, np.ndarray]:
    """innovation: measured less expected of a nominal state; R: variances of its noise."""
    H = -differences(lambda d: innovation(moved(s, d)))
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(R))
    d, I_KH = K @ innovation(s), np.eye(15) - K @ H
    P = I_KH @ P @ I_KH.T + K @ np.diag(R) @ K.T
    after = moved(s, d)
    G = differences(lambda e: apart(after, moved(s, d + e)))  # the error about the new nominal state
    return after, G @ P @ G.T
