"""Linear regression on flight logs, with confidence intervals that are valid for correlated errors.

    y = X c + e,      c minimises sum rho(e),      rho(e) = e^2 / 2 ("squares") or Huber's ("huber", see huber.py)

Residuals of a model on a flight are correlated in time (missing drag terms, motor lag, gusts), so the variance for
independent errors, s^2 (X'X)^-1, is much too small. The scores X_k rho'(e_k) are therefore summed over contiguous
blocks longer than their correlation time, and the variance is the sandwich estimate over the G block sums,

    V = G/(G - p) H^-1 (sum_g s_g s_g') H^-1,     H = X' diag(rho'') X

with Student's t of G - p degrees of freedom (after Bester, Conley & Hansen 2011, Inference with dependent data using
cluster covariance estimators; their G - 1 is too narrow for six blocks and two coefficients). A block has a length of
BLOCK_TIMES integrated autocorrelation times of the score with the longest correlation.
With FLIGHT_CLUSTERS or more flights, the flights are the blocks; the intervals then include differences between flights
(battery, offsets, temperature). With fewer they do not; estimates per flight show the differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from quadexp.errors import DataError, UsageError
from quadexp.learn.huber import LOSSES, solve

BLOCK_TIMES = 8.0
FLIGHT_CLUSTERS = 10
MOST_LAGS = 1 << 17  # samples of a stretch; longer stretches are averaged over neighbours first
LEAST_BLOCKS = 6  # more than coefficients, for any correlation time
CONDITION_LIMIT = 1000.0  # of the columns at unit length: largest amplification of noise in the coefficients


@dataclass(frozen=True)
class Regression:
    """coefficients: (p,). covariance: (p, p), see the module. plain: (p, p), for independent errors, for comparison.

    residual: (n,). blocks: G. condition: condition number of the columns at unit length.
    """

    names: tuple[str, ...]
    coefficients: np.ndarray
    covariance: np.ndarray
    plain: np.ndarray
    residual: np.ndarray
    blocks: int
    condition: float

    @property
    def errors(self) -> np.ndarray:
        """Standard errors, (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def freedom(self) -> int:
        """Degrees of freedom of Student's t, G - p."""
        return max(self.blocks - len(self.coefficients), 1)

    def half_width(self, confidence: float = 0.95) -> np.ndarray:
        """Half the confidence interval, (p,)."""
        return half_width(self.errors, self.freedom, confidence)


def half_width(errors: npt.ArrayLike, freedom: int, confidence: float = 0.95) -> np.ndarray:
    """Half a confidence interval of standard errors, Student's t with that many degrees of freedom."""
    from scipy.stats import t as student_t

    return student_t.ppf(0.5 + confidence / 2, max(freedom, 1)) * np.asarray(errors)


def regress(
    design: np.ndarray,
    target: np.ndarray,
    names: Sequence[str],
    stretch: np.ndarray,
    flight: np.ndarray,
    *,
    what: str,
    loss: str = "squares",
    intervals: bool = True,
) -> Regression:
    """Fit target (n,) by design (n, p).

    stretch: (n,), number of the uninterrupted stretch of each row, ascending. flight: (n,). what: for messages.
    intervals: False computes the variance for independent errors only, which is faster.
    Raises DataError for too few rows, and for columns whose coefficients are not determined, naming them.
    """
    if loss not in LOSSES:
        raise UsageError(f"loss '{loss}' is none of {', '.join(LOSSES)}")
    n, p = design.shape
    if n < max(p + 2, 2 * (p + LEAST_BLOCKS)):
        raise DataError(
            f"{what}: {n} samples for {p} coefficients, at least {max(p + 2, 2 * (p + LEAST_BLOCKS))} are needed"
        )
    length = np.linalg.norm(design, axis=0)
    x = _unit_columns(design, length, names, what)
    condition = _condition(x, names, what)
    coefficients, limit = solve(x, target, loss)
    residual = target - x @ coefficients
    inside = x if np.isinf(limit) else x * (np.abs(residual) <= limit)[:, None]
    information = inside.T @ x
    plain = np.linalg.inv(information) / np.outer(length, length) * (residual @ residual / (n - p))
    if not intervals:
        return Regression(tuple(names), coefficients / length, plain, plain, residual, n, condition)
    scores = x * np.clip(residual, -limit, limit)[:, None]
    groups = blocks_of(scores, stretch, flight)
    count = int(groups.max()) + 1
    sums = np.stack([np.bincount(groups, column, count) for column in scores.T], axis=1)
    half = np.linalg.solve(information, sums.T) / length[:, None]
    covariance = count / max(count - p, 1) * half @ half.T
    return Regression(tuple(names), coefficients / length, covariance, plain, residual, count, condition)


def _unit_columns(design: np.ndarray, length: np.ndarray, names: Sequence[str], what: str) -> np.ndarray:
    if not length.all():
        raise DataError(
            f"{what}: {names[int(np.argmin(length))]} is zero in all samples, so its coefficient is not determined"
        )
    return design / length


def _condition(x: np.ndarray, names: Sequence[str], what: str) -> float:
    _, values, vectors = np.linalg.svd(np.linalg.qr(x, mode="r"))
    condition = float(values[0] / max(values[-1], 1e-300))
    if condition > CONDITION_LIMIT:
        mixed = [name for name, share in zip(names, vectors[-1], strict=True) if abs(share) > 0.2]
        raise DataError(
            f"{what}: {', '.join(mixed)} cannot be told apart in these flights (condition number {condition:.3g},"
            f" {CONDITION_LIMIT:g} is allowed): add flights with more motion, or leave one of them out"
        )
    return condition


def autocorrelation_time(series: np.ndarray) -> float:
    """Integrated autocorrelation time of (k,), in samples: 1 for white noise (Geyer 1992, initial positive terms).

    Beyond MOST_LAGS samples neighbours are averaged first; the result is then at least their number.
    """
    together = -(-len(series) // MOST_LAGS)
    if together > 1:
        means = series[: len(series) // together * together].reshape(-1, together).mean(axis=1)
        return together * autocorrelation_time(means)
    k = len(series)
    centred = series - series.mean()
    variance = centred @ centred
    if k < 4 or not variance > 0:
        return 1.0
    spectrum = np.fft.rfft(centred, 1 << (2 * k - 1).bit_length())
    correlation = np.fft.irfft(np.abs(spectrum) ** 2)[: k // 2] / variance
    pairs = correlation[: len(correlation) // 2 * 2].reshape(-1, 2).sum(axis=1)
    stop = np.flatnonzero(pairs <= 0)
    return max(1.0, 2 * float(pairs[: stop[0] if len(stop) else None].sum()) - 1)


def blocks_of(scores: np.ndarray, stretch: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Block number of every row, (n,), from 0; scores (n, p)."""
    flights, of_flight = np.unique(flight, return_inverse=True)
    if len(flights) >= FLIGHT_CLUSTERS:
        return of_flight
    starts = np.flatnonzero(np.r_[True, stretch[1:] != stretch[:-1]])
    sizes = np.diff(np.r_[starts, len(stretch)])
    longest = np.argsort(sizes)[-FLIGHT_CLUSTERS:]
    times = [
        [autocorrelation_time(scores[starts[i] : starts[i] + sizes[i], j]) for i in longest]
        for j in range(scores.shape[1])
    ]
    time = float(np.max(np.average(times, axis=1, weights=sizes[longest])))
    block = int(min(np.ceil(BLOCK_TIMES * time), max(len(stretch) // (LEAST_BLOCKS + scores.shape[1]), 1)))
    counts = np.maximum(1, np.round(sizes / block).astype(int))
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return np.concatenate([a + np.arange(size) * c // size for a, size, c in zip(first, sizes, counts, strict=True)])
