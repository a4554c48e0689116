"""Lei & Li 2017 computed by hand: plain numpy and scipy, scalar by scalar, in the paper's NED/FRD and its own letters.

Nothing of quadexp is used here, so that agreement means something.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

M, D, R, C, TH, G, RHO = 0.985, 0.225, 0.120, 0.025, math.radians(15), 9.81, 1.205
S = math.pi * D**2
C_LA, C_D0, C_D = 3.320, 0.220, np.array([0.010, 0.010, 0.020])
J = 1e-2 * np.array([[0.9560, 0, 0.1019], [0, 0.9417, 0.1019], [0.1019, 0.1019, 1.8762]])
HOVER = math.sqrt(M * G / 4 / (2 * RHO * math.pi * R**2))  # V_I in hover, m/s


class Point(NamedTuple):
    """One state of the air: all of the paper's quantities, FRD."""

    V_I: np.ndarray
    T: np.ndarray
    H: np.ndarray
    Q: np.ndarray
    F: np.ndarray
    Gamma: np.ndarray


def thrust(w: float, V_h: float, V_z: float, V_I: float, C_la: float = C_LA, A: float = 0.5) -> float:
    """(14)."""
    u = V_I - V_z
    return RHO * C * C_la * (R**3 * TH * w**2 / 3 - R**2 * u * w / 2 + A * R * TH * V_h**2)


def induced(w: float, V_h: float, V_z: float, C_la: float = C_LA, A: float = 0.5) -> float:
    """The largest root of (14) = (17): scanned from above, then Brent's method."""

    def g(V_I):
        momentum = 2 * RHO * math.pi * R**2 * V_I * np.hypot(V_h, V_I - V_z)
        return momentum - thrust(w, V_h, V_z, V_I, C_la, A)

    grid = np.linspace(60, min(V_z, 0) - 1, 6000)
    first = int(np.argmax(g(grid) < 0))
    return brentq(g, grid[first], grid[first - 1], xtol=1e-15, rtol=9e-16, maxiter=300)


def point(V, w, *, C_la=C_LA, C_d0=C_D0, C_D=C_D, A=0.5, B=1 / 6) -> Point:
    """(4)-(7), (14)-(17) at the body velocity V (3,) FRD (m/s) and the rotor speeds w (4,) (rad/s)."""
    V, w = np.asarray(V, float), np.asarray(w, float)
    V_h, V_z = math.hypot(V[0], V[1]), V[2]
    V_I = np.array([induced(w_i, V_h, V_z, C_la, A) for w_i in w])
    u = V_I - V_z
    T = np.array([thrust(w_i, V_h, V_z, V_Ii, C_la, A) for w_i, V_Ii in zip(w, V_I, strict=True)])
    H = RHO * C * (R**2 * C_d0 * V_h * w / 2 - B * R * TH * C_la * V_h * u + C_la * V_h * u**2 / w / 2)
    Q = RHO * C * R**2 * C_d0 * (R**2 * w**2 + 3 * V_h**2) / 4 + T * u / w + H * V_h / w
    drag = 0.5 * RHO * S * np.linalg.norm(V) * C_D * V
    along = V[:2] / V_h if V_h > 0 else np.zeros(2)
    F = np.array([-along[0] * H.sum(), -along[1] * H.sum(), -T.sum()]) - drag
    Gamma = np.array([D * (T[3] - T[1]), D * (T[0] - T[2]), -Q[0] + Q[1] - Q[2] + Q[3]])
    return Point(V_I, T, H, Q, F, Gamma)


def flip(vector) -> np.ndarray:
    """FRD to FLU, or back: y and z change their sign."""
    return np.asarray(vector) * [1.0, -1.0, -1.0]
