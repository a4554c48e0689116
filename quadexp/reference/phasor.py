"""A point on the unit circle and its time derivatives, for paths in sines and cosines of one angle.

    z(t) = exp(i th(t)),    z^(n) = z B_n(i th', i th'', i th''', i th'''')

with B_n the complete Bell polynomials (Faa di Bruno): cos th is the real part, sin th the imaginary part.
"""

from __future__ import annotations

import numpy as np


def phasor(angle: np.ndarray) -> np.ndarray:
    """exp(i th) and its derivatives up to the fourth, complex (k, 5).

    angle: th and its derivatives, (k, 5) (rad, s).
    """
    x1, x2, x3, x4 = 1j * angle[:, 1:].T
    fourth = x1**4 + 6 * x1**2 * x2 + 4 * x1 * x3 + 3 * x2**2 + x4
    third = x1**3 + 3 * x1 * x2 + x3
    bell = np.stack([np.ones_like(x1), x1, x1**2 + x2, third, fourth], axis=1)
    return np.exp(1j * angle[:, :1]) * bell
