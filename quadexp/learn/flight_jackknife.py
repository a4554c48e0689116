"""Standard errors over flights by the delete-one jackknife.

Errors within a flight are correlated (same path, speeds, battery), and the bias of a model that is too simple differs
between flights, so flights, not rows, are the independent units. With c_g the coefficients without flight g,

    variance = (G - 1)/G sum_g (c_g - c)^2

(delete-one-cluster jackknife, CR3: MacKinnon, Nielsen & Webb 2023, J. Econometrics 232(2)). Each c_g is a separate fit
including the scale of Huber's loss; a sandwich estimator, which treats that scale as known, covers the truth in only 82
to 88 % of data sets. A few fast flights dominate a drag coefficient, so Student's t has Satterthwaite's degrees of
freedom, with a flight's share of the variance proportional to the square of its share h_g of the information on
coefficient j, as for a model that is too simple:

    (sum_g h_g^2)^2 / sum_g h_g^4 - 1,      h_g = sum_{k in g} a_k^2 / sum_k a_k^2,      a = X (X'X)^-1 e_j

which is G - 1 for equal flights, and at least 1. More than MOST_GROUPS flights are deleted in groups.
"""

from __future__ import annotations

import numpy as np

from quadexp.learn.huber import solve

MOST_GROUPS = 40
TOLERANCE = 1e-7  # of each fit
LEAST_PIVOT = 1e-8  # of the R factor at unit columns


def flight_errors(
    x: np.ndarray, target: np.ndarray, flight: np.ndarray, coefficients: np.ndarray, loss: str
) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors (p,) and degrees of freedom (p,) of the fit `coefficients` of target (n,) on x (n, p).

    x: columns of unit length. flight: (n,). Zeros where no interval exists: for one flight, or where the flights
    without one of them do not determine the coefficients.
    """
    number = np.unique(flight, return_inverse=True)[1]
    groups = number % MOST_GROUPS
    count, p = int(groups.max()) + 1, x.shape[1]
    undefined = np.zeros(p), np.zeros(p)
    if count < 2:
        return undefined
    deviation = np.empty((count, p))
    for g in range(count):
        rest = groups != g
        if rest.sum() < p + 1 or np.abs(np.diag(np.linalg.qr(x[rest], mode="r"))).min() < LEAST_PIVOT:
            return undefined
        deviation[g] = solve(x[rest], target[rest], loss, start=coefficients, tolerance=TOLERANCE)[0] - coefficients
    errors = np.sqrt((count - 1) / count * np.sum(deviation**2, axis=0))
    influence = x @ np.linalg.inv(x.T @ x)
    share = np.stack([np.bincount(groups, column**2, count) for column in influence.T], axis=1)
    part = share**2 / np.sum(share**2, axis=0)
    return errors, np.maximum(1 / np.sum(part**2, axis=0) - 1, 1.0)
