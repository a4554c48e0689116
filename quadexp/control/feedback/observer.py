"""High-gain observer for the derivatives of a desired angle, Lei & Li 2017, equation (36).

    x_k = e^{A h} x_{k-1} + int_0^h e^{A s} ds B y_k,    A = [-l1 1 0; -l2 0 1; -l3 0 0],  B = (l1, l2, l3)

with l = (3 w0, 3 w0^2, w0^3), all poles at -w0 (rad/s): x_2 estimates the first derivative of y, x_3 the second.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm


def observer_matrices(bandwidth: float, period: float) -> tuple[np.ndarray, np.ndarray]:
    """e^{A h}, (3, 3), and int e^{A s} ds B, (3,): exact for y held over a period.

    bandwidth: w0 (rad/s). period: h (s).
    """
    gains = np.array([3 * bandwidth, 3 * bandwidth**2, bandwidth**3])
    augmented = np.zeros((4, 4))
    augmented[:3, 0], augmented[0, 1], augmented[1, 2], augmented[:3, 3] = -gains, 1.0, 1.0, gains
    exact = expm(augmented * period)
    return exact[:3, :3], exact[:3, 3]
