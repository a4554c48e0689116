"""State and input layout, in SI units.

World frame ENU (z up), body frame FLU (x forward, y left, z up). Quaternion body to world, Hamilton, w first.

    x = [p (world, m), q (-), v (world, m/s), w (body, rad/s)]      13 numbers
    u = [T_0 .. T_{n-1}]                                            commanded static rotor thrusts (N)
"""

from __future__ import annotations

import numpy as np

POSITION = slice(0, 3)  # world, m
ATTITUDE = slice(3, 7)  # body to world, w first
VELOCITY = slice(7, 10)  # world, m/s
RATE = slice(10, 13)  # body, rad/s
N_STATE = 13  # position 3, attitude 4, velocity 3, body rate 3
AT_REST = 1e-6  # m/s; a path that begins at rest is slower by rounding errors only

STATE_COLUMNS = ("p_x", "p_y", "p_z", "q_w", "q_x", "q_y", "q_z", "v_x", "v_y", "v_z", "w_x", "w_y", "w_z")


def input_columns(n_rotors: int) -> tuple[str, ...]:
    """Names of the input columns, `u_0` .. `u_{n-1}`."""
    return tuple(f"u_{i}" for i in range(n_rotors))


def in_motion(state: np.ndarray) -> bool:
    """Whether a state (13,) has a velocity."""
    return bool(np.abs(state[VELOCITY]).max() > AT_REST)


def norms(vectors: np.ndarray) -> np.ndarray:
    """Euclidean norm of every row, (k, m) -> (k,)."""
    return np.linalg.norm(vectors, axis=1)


def root_mean_square(values: np.ndarray) -> float:
    """Of all numbers, whatever their shape."""
    return float(np.sqrt(np.mean(values**2)))


def finite_rows(values: np.ndarray) -> np.ndarray:
    """Mask of the rows, (k,), whose values (k, m) are all finite."""
    return np.isfinite(values).all(axis=1)
