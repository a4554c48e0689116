"""Initial inducing points: chosen greedily where the prior variance given the others is largest.

Each step takes argmax_i k_ii - q_ii, q = K_XZ K_ZZ^-1 K_ZX, by a partial pivoted Cholesky factorisation, O(n M^2)
(Burt, Rasmussen & van der Wilk 2020, "Convergence of sparse variational inference in GP regression", section 6.2).
"""

from __future__ import annotations

import numpy as np

RELATIVE_FLOOR = 1e-10  # of the prior variance; below it a further point is redundant


def greedy_points(x: np.ndarray, lengthscale: np.ndarray, count: int) -> np.ndarray:
    """Indices (count,) of the chosen rows, most informative first.

    x: rows to choose from, (n, d), n >= count. lengthscale: (d,), same units. Where fewer rows reduce the variance to
    zero, the remaining ones are taken in their order.
    """
    n = len(x)
    if count > n:
        raise ValueError(f"{count} points of {n} rows")
    scaled = x / lengthscale
    variance = np.ones(n)
    factor = np.empty((count, n))
    chosen: list[int] = []
    while len(chosen) < count:
        pivot = int(np.argmax(variance))
        if variance[pivot] < RELATIVE_FLOOR:
            rest = np.setdiff1d(np.arange(n), chosen, assume_unique=True)
            return np.concatenate([chosen, rest[: count - len(chosen)]]).astype(int)
        k = np.exp(-0.5 * np.sum((scaled - scaled[pivot]) ** 2, axis=1))
        row = (k - factor[: len(chosen), pivot] @ factor[: len(chosen)]) / np.sqrt(variance[pivot])
        factor[len(chosen)] = row
        variance = np.maximum(variance - row**2, 0.0)
        variance[pivot] = 0.0
        chosen.append(pivot)
    return np.array(chosen)
