"""Linear regression by Huber's loss (Huber 1964), or by least squares.

    minimise sum_k rho(y_k - x_k c),    rho(e) = e^2/2 for |e| <= L, L (|e| - L/2) beyond,    L = 1.345 * 1.4826 median
    |e|

by iterative reweighting. rho is quadratic up to 1.345 robust standard deviations: 95 % efficient for normal errors.
"""

from __future__ import annotations

import numpy as np

LOSSES = ("huber", "squares")
HUBER = 1.345  # robust standard deviations
MAD_TO_STD = 1.4826
MAX_ITERATIONS = 200  # of reweighting


def solve(
    x: np.ndarray, target: np.ndarray, loss: str, *, start: np.ndarray | None = None, tolerance: float = 1e-12
) -> tuple[np.ndarray, float]:
    """Coefficients (p,) of target (n,) on x (n, p), and the residual L beyond which the loss is linear.

    loss: one of LOSSES. start: initial coefficients of the reweighting, None for least squares. tolerance: relative, of
    the last change.
    """
    coefficients = start if start is not None and loss == "huber" else np.linalg.lstsq(x, target, rcond=None)[0]
    limit = float(np.inf)
    for _ in range(MAX_ITERATIONS if loss == "huber" else 0):
        residual = target - x @ coefficients
        limit = HUBER * MAD_TO_STD * float(np.median(np.abs(residual)))
        if not limit > 1e-12 * np.abs(target).max():  # most residuals are zero
            return coefficients, np.inf
        root = np.sqrt(np.minimum(1.0, limit / np.maximum(np.abs(residual), limit)))
        before, coefficients = coefficients, np.linalg.lstsq(x * root[:, None], target * root, rcond=None)[0]
        if np.abs(coefficients - before).max() <= tolerance * np.abs(coefficients).max():
            break
    return coefficients, limit
