"""Linear regression on flight logs, by least squares or Huber's loss, with intervals valid for correlated errors.

    y = X c + e,      c minimises sum rho(e),      rho(e) = e^2 / 2      (loss="squares")

loss="huber" (Huber 1964): rho(e) = e^2/2 for |e| <= L and L (|e| - L/2) beyond, L = 1.345 * 1.4826 median |e|, by
iterative reweighting; 1.345 robust standard deviations are 95 % efficient for normal errors.

Residuals of a model on a flight are correlated in time (missing drag terms, motor lag, gusts), so the variance for
independent errors, s^2 (X'X)^-1, is much too small.

The bias of a model that is too simple differs between flights, so these are the independent units, by the delete-one
jackknife: with c_g the coefficients without flight g,

    V = (G - 1)/G sum_g (c_g - c) (c_g - c)'

(delete-one-cluster jackknife, CR3: MacKinnon, Nielsen & Webb 2023, J. Econometrics 232(2)). Each c_g is a separate fit
including the scale of Huber's loss; a sandwich estimator, which treats that scale as known, covers the truth in only 82
to 88 % of data sets. A few fast flights dominate a drag coefficient, so Student's t has Satterthwaite's degrees of
freedom, with a flight's share of the variance proportional to the square of its share h_g of the information on
coefficient j, as for a model that is too simple:

    (sum_g h_g^2)^2 / sum_g h_g^4 - 1,      h_g = sum_{k in g} a_k^2 / sum_k a_k^2,      a = X (X'X)^-1 e_j

which is G - 1 for equal flights, and at least 1. More than MOST_GROUPS flights are deleted in groups.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from quadexp.errors import DataError

HUBER = 1.345  # robust standard deviations
MAD_TO_STD = 1.4826  # of a normal distribution: 1 / Phi^-1(3/4)
MAX_ITERATIONS = 200  # of reweighting
LEAST_FLIGHTS = 3  # of an interval over flights: Student's t of two is 12.7 standard errors, which tells nothing
MOST_GROUPS = 40  # of flights that are deleted
TOLERANCE = 1e-7  # of the fit without one
LEAST_PIVOT = 1e-8  # of the R factor at unit columns
CONDITION_LIMIT = 1e8  # of the columns at unit length: the largest amplification of rounding


@dataclass(frozen=True)
class Regression:
    """coefficients: (p,). covariance: (p, p), see the module. residual: (n,).
    freedom: degrees of freedom of Student's t, () or (p,); 0 where there is no interval. condition:
       condition number of the columns at unit length.
    """

    names: tuple[str, ...]
    coefficients: np.ndarray
    covariance: np.ndarray
    residual: np.ndarray
    freedom: np.ndarray
    condition: float

    @property
    def errors(self) -> np.ndarray:
        """Standard errors, (p,)."""
        return np.sqrt(np.diag(self.covariance))

    def half_width(self, confidence: float = 0.95) -> np.ndarray:
        """Half the confidence interval, (p,)."""
        return half_width(self.errors, self.freedom, confidence)


def half_width(errors: npt.ArrayLike, freedom: npt.ArrayLike, confidence: float = 0.95) -> np.ndarray:
    """Half a confidence interval of standard errors, Student's t with that many degrees of freedom."""
    from scipy.stats import t as student_t

    return student_t.ppf(0.5 + confidence / 2, np.maximum(freedom, 1)) * np.asarray(errors)


@dataclass(frozen=True)
class Solved:
    """x: columns at unit length, (n, p). length: of the columns, (p,). coefficients: of x, (p,). limit: L, infinite for
    squares. residual: (n,). condition: condition number of x."""

    x: np.ndarray
    length: np.ndarray
    coefficients: np.ndarray
    limit: float
    residual: np.ndarray
    condition: float

    def with_intervals(self, names: Sequence[str], covariance: np.ndarray, freedom: np.ndarray) -> Regression:
        """covariance: of the coefficients of x, (p, p)."""
        covariance = covariance / np.outer(self.length, self.length)
        coefficients = self.coefficients / self.length
        return Regression(tuple(names), coefficients, covariance, self.residual, freedom, self.condition)


def solved(
    design: np.ndarray, target: np.ndarray, names: Sequence[str], *, what: str, loss: str, least: int, condition: float
) -> Solved:
    """Fit target (n,) by design (n, p). least: samples that are needed. condition: the largest that is allowed.

    Raises DataError for too few rows, and for columns whose coefficients are not determined, naming them.
    """
    n, p = design.shape
    if n < least:
        raise DataError(f"{what}: {n} samples for {p} coefficients, at least {least} are needed")
    length = np.linalg.norm(design, axis=0)
    if not length.all():
        raise DataError(
            f"{what}: {names[int(np.argmin(length))]} is zero in all samples, so its coefficient is not determined"
        )
    x = design / length
    found = _condition(x, names, what, condition)
    coefficients, limit = solve(x, target, loss)
    return Solved(x, length, coefficients, limit, target - x @ coefficients, found)


def regress(
    design: np.ndarray, target: np.ndarray, names: Sequence[str], flight: np.ndarray, *,
    what: str, loss: str = "squares", intervals: bool = True,
) -> Regression:  # fmt: skip
    """Fit target (n,) by design (n, p), whose columns may be as alike as rounding allows, with intervals over flights.

    flight: (n,). what: for messages. intervals: False computes no variance. Raises as `solved` does.
    """
    p = design.shape[1]
    fit = solved(design, target, names, what=what, loss=loss, least=p + 2, condition=CONDITION_LIMIT)
    covariance = np.zeros((p, p))
    freedom = np.zeros(p)
    if intervals:
        covariance, freedom = _over_flights(fit.x, target, flight, fit.coefficients, loss)
    return fit.with_intervals(names, covariance, freedom)


def solve(
    x: np.ndarray, target: np.ndarray, loss: str, *, start: np.ndarray | None = None, tolerance: float = 1e-12
) -> tuple[np.ndarray, float]:
    """Coefficients (p,) of target (n,) on x (n, p), and the residual L beyond which the loss is linear.

    loss: see the module. start: initial coefficients of the reweighting, None for least squares. tolerance: relative,
    of the last change.
    """
    coefficients = start if start is not None and loss == "huber" else np.linalg.lstsq(x, target, rcond=None)[0]
    limit = float(np.inf)
    for _ in range(MAX_ITERATIONS if loss == "huber" else 0):
        residual = target - x @ coefficients
        limit = HUBER * MAD_TO_STD * float(np.median(np.abs(residual)))
        if not limit > 1e-12 * np.abs(target).max():  # most residuals are zero
            return coefficients, np.inf
        root = np.sqrt(np.minimum(1.0, limit / np.maximum(np.abs(residual), limit)))
        before = coefficients
        coefficients = np.linalg.lstsq(x * root[:, None], target * root, rcond=None)[0]
        if np.abs(coefficients - before).max() <= tolerance * np.abs(coefficients).max():
            break
    return coefficients, limit


def _condition(x: np.ndarray, names: Sequence[str], what: str, limit: float) -> float:
    _, values, vectors = np.linalg.svd(np.linalg.qr(x, mode="r"))
    condition = float(values[0] / max(values[-1], 1e-300))
    if condition > limit:
        mixed = [name for name, share in zip(names, vectors[-1], strict=True) if abs(share) > 0.2]
        raise DataError(
            f"{what}: {', '.join(mixed)} cannot be distinguished in these flights (condition number {condition:.3g},"
            f" {limit:g} is allowed): add flights with more motion, or leave one of them out"
        )
    return condition


def _over_flights(
    x: np.ndarray, target: np.ndarray, flight: np.ndarray, coefficients: np.ndarray, loss: str
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance (p, p) and degrees of freedom (p,) of a fit, from those without each of its flights.

    Zeros where no interval exists: for one flight, or where the others do not determine the coefficients.
    """
    number = np.unique(flight, return_inverse=True)[1]
    groups = number % MOST_GROUPS
    count = int(groups.max()) + 1
    p = x.shape[1]
    undefined = np.zeros((p, p)), np.zeros(p)
    if count < 2:
        return undefined
    deviation = np.empty((count, p))
    for g in range(count):
        rest = groups != g
        if rest.sum() < p + 1 or np.abs(np.diag(np.linalg.qr(x[rest], mode="r"))).min() < LEAST_PIVOT:
            return undefined
        deviation[g] = solve(x[rest], target[rest], loss, start=coefficients, tolerance=TOLERANCE)[0] - coefficients
    influence = x @ np.linalg.inv(x.T @ x)
    share = np.column_stack([np.bincount(groups, column**2, count) for column in influence.T])
    part = share**2 / np.sum(share**2, axis=0)
    freedom = np.maximum(1 / np.sum(part**2, axis=0) - 1, 1.0)
    return (count - 1) / count * deviation.T @ deviation, freedom


def between_flights(logs: np.ndarray, weights: np.ndarray, confidence: float = 0.95) -> float:
    """Half the interval of ln of a mean over flights that differ from one another: a random effect of the flight,

        t s sqrt(sum_f h_f^2),    s^2 = sum_f (y_f - mean y)^2 / (G - 1),    h_f = w_f / sum w

    with Student's t of G - 1 degrees of freedom: for flights alike in length the interval of Hartung & Knapp (2001,
    Stat. Med. 20), in which the scatter between flights, not that within, is what is known of a new one.
    logs: y_f, ln of the number in each flight, (G,). weights: w_f, of each in the mean, (G,). NaN for fewer than
    LEAST_FLIGHTS, whose scatter is not known well enough.
    """
    if len(logs) < LEAST_FLIGHTS:
        return float("nan")
    share = weights / weights.sum()
    return float(half_width(np.std(logs, ddof=1) * np.sqrt(share @ share), len(logs) - 1, confidence))
