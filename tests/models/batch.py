"""Regularised least squares of all samples at once: what recursive least squares must end at."""

import numpy as np


def batch_least_squares(
    regressors: np.ndarray, target: np.ndarray, *, prior: np.ndarray, covariance: np.ndarray, noise: float = 1.0,
    forgetting: float = 1.0, estimates: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Minimum of |y - Phi theta|^2 / noise^2 + (theta - prior)^T covariance^-1 (theta - prior), (p,).

    regressors Phi: (k, p). target y: (k,). prior: (p,). covariance: (p, p). forgetting, lambda: all this weighs
    lambda^age, and each period adds (1 - lambda) (theta - theta_k)^T covariance^-1 (theta - theta_k), of the age of its
    sample, with the estimates theta_k before each sample, (k, p).
    """
    samples, root = len(target), np.linalg.cholesky(np.linalg.inv(covariance)).T
    age = np.sqrt(forgetting) ** np.arange(samples)[::-1]
    system, right = [regressors / noise * age[:, None]], [target / noise * age]
    pulls = [(prior, np.sqrt(forgetting) ** samples)]
    if estimates is not None:
        pulls += [(one, np.sqrt(1 - forgetting) * weight) for one, weight in zip(estimates, age, strict=True)]
    for towards, weight in pulls:
        system.append(weight * root)
        right.append(weight * root @ towards)
    return np.linalg.lstsq(np.vstack(system), np.concatenate(right), rcond=None)[0]
