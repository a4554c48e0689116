"""Linear regression as quadexp.models.regression, with intervals over blocks of time.

The scores X_k rho'(e_k) are summed over contiguous blocks longer than their correlation time, and the variance is the
sandwich estimate over the G block sums,

    V = G/(G - p) H^-1 (sum_g s_g s_g') H^-1,     H = X' diag(rho'') X

with Student's t of G - p degrees of freedom (after Bester, Conley & Hansen 2011, Inference with dependent data using
cluster covariance estimators; their G - 1 is too narrow for six blocks and two coefficients). A block has a length of
BLOCK_TIMES integrated autocorrelation times of the score with the longest correlation.
With FLIGHT_CLUSTERS or more flights, the flights are the blocks; the intervals then include differences between flights
(battery, offsets, temperature). With fewer they do not; estimates per flight show the differences.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from quadexp.models.regression import Regression, solved

BLOCK_TIMES = 8.0  # beyond, exp(-8) of the correlation is left between neighbouring blocks
FLIGHT_CLUSTERS = 10  # with 10 a standard deviation over flights is known to a quarter
MOST_LAGS = 1 << 17  # samples of a stretch; longer stretches are averaged over neighbours first
LEAST_BLOCKS = 6  # more than coefficients, for any correlation time
CONDITION_LIMIT = 1000.0  # of the columns at unit length: the largest amplification of noise in the coefficients


def regress(
    design: np.ndarray, target: np.ndarray, names: Sequence[str], stretch: np.ndarray, flight: np.ndarray, *,
    what: str, loss: str = "squares", intervals: bool = True,
) -> Regression:  # fmt: skip
    """Fit target (n,) by design (n, p).

    stretch: (n,), number of the uninterrupted stretch of each row, ascending. flight: (n,). what: for messages.
    intervals: False computes the variance for independent errors only, which is faster. Raises as `solved` does.
    """
    n, p = design.shape
    least = max(p + 2, 2 * (p + LEAST_BLOCKS))
    fit = solved(design, target, names, what=what, loss=loss, least=least, condition=CONDITION_LIMIT)
    inside = fit.x if np.isinf(fit.limit) else fit.x * (np.abs(fit.residual) <= fit.limit)[:, None]
    information = inside.T @ fit.x
    if intervals:
        scores = fit.x * np.clip(fit.residual, -fit.limit, fit.limit)[:, None]
        covariance, blocks = over_blocks(scores, information, stretch, flight)
        freedom = np.array(max(blocks - p, 1))
    else:
        covariance = np.linalg.inv(information) * (fit.residual @ fit.residual / (n - p))
        freedom = np.array(n - p)
    return fit.with_intervals(names, covariance, freedom)


def over_blocks(
    scores: np.ndarray, information: np.ndarray, stretch: np.ndarray, flight: np.ndarray, prior: npt.ArrayLike = 0.0
) -> tuple[np.ndarray, int]:
    """Covariance (p, p) over blocks and their number, from the scores (n, p) and H (p, p) of a fit.

    prior: P_0^-1 of coefficients with a prior, (p, p), which adds to the scatter of the block sums.
    """
    groups = blocks_of(scores, stretch, flight)
    count = int(groups.max()) + 1
    p = scores.shape[1]
    sums = np.column_stack([np.bincount(groups, column, count) for column in scores.T])
    half = np.linalg.solve(information, sums.T)
    inverse = np.linalg.inv(information)
    return count / max(count - p, 1) * half @ half.T + inverse @ np.broadcast_to(prior, (p, p)) @ inverse, count


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
