"""Regularised least squares of all samples at once: what recursive least squares must end at."""

from __future__ import annotations

import numpy as np


def batch_least_squares(
    regressors: np.ndarray, target: np.ndarray, *, prior: np.ndarray, covariance: np.ndarray, noise: float = 1.0
) -> np.ndarray:
    """Minimum of |y - Phi theta|^2 / noise^2 + (theta - prior)^T covariance^-1 (theta - prior), (p,).

    regressors Phi: (k, p). target y: (k,). prior: (p,). covariance: (p, p).
    """
    root = np.linalg.cholesky(np.linalg.inv(covariance)).T
    system = np.vstack([regressors / noise, root])
    return np.linalg.lstsq(system, np.concatenate([target / noise, root @ prior]), rcond=None)[0]
