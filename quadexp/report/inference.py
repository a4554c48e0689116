"""Intervals, effect sizes and tests of a few paired values. Arrays in, numbers out.

With n values x_i, mean m, standard deviation s, confidence 1 - alpha, and paired differences d_i = x_i - b_i:

    mean       BCa bootstrap (Efron 1987, JASA 82(397)) where it can hold its confidence; else m +- t s / sqrt(n)
    reduction  100 (1 - mean x / mean b), the same two ways
    share      (k + z^2/2 +- z sqrt(k (n - k) / n + z^2/4)) / (n + z^2)        (Wilson 1927, JASA 22(158))
    p          share of the 2^n sign patterns g with |sum g_i d_i| >= |sum d_i|  (Fisher 1935, Design of Experiments)
    effect     (R- - R+) / (R- + R+), R the rank sums of |d_i| by sign of d_i    (Kerby 2014, Compr. Psychol. 3)
    ratio      exp(L +- t s), L = mean_c mean_i ln(x_ci / b_ci) over C conditions, s^2 = sum_c s_c^2 / n_c / C^2, with
               Satterthwaite's degrees of freedom (sum_c v_c)^2 / sum_c (v_c^2 / (n_c - 1)), v_c = s_c^2 / n_c
               (Satterthwaite 1946, Biometrics 2(6)); its p is that of L = 0
    Holm       p_(i) -> max over j <= i of min(1, (m - j + 1) p_(j))             (Holm 1979, Scand. J. Stat. 6(2))

The bootstrap needs 6 values for 95 %: it stays within the range of the data, which contains the median with probability
1 - 2^(1-n). For few values it is too narrow, so its level is widened to that of t, Phi(-sqrt(n/(n-1)) t) a side
(Hesterberg 2015, Am. Stat. 69(4), section 3.3): on normal data, 95 % intervals of 6, 8 and 10 values then contain the
mean in 93, 94 and 95 % of the cases; the plain BCa has 85, 88 and 90 %. Above 200 values it agrees with t.

The permutation test, unlike Wilcoxon's, tests the difference of means that the tables show. Paired flights have the
same noise, so their differences have a small standard deviation and Cohen's d reaches hundreds; the rank-biserial
effect is bounded. Both are given.

Bootstrap and drawn sign patterns are scipy's. Wilson's limits and ranks are written here, in four lines and two,
because importing scipy.stats takes as long as a dozen flights; and the exact count: scipy's `permutation_test` is exact
up to 16 pairs only and takes 0.4 s for them. Holm needs no statsmodels for its eight lines.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri, stdtr, stdtrit

RESAMPLES = 9999
MOST_BOOTSTRAPPED = 200  # values; beyond, the t interval is the same
MOST_EXACT = 30  # pairs whose 2^n sign patterns are counted
MOST_DRAWN = 200  # pairs whose sign patterns are drawn; beyond, their sum is normal
DRAWS = 99_999
BATCH = 10_000  # patterns at a time
SAME = 1e-12  # relative difference below which two sums are one


class Interval(NamedTuple):
    """Confidence limits. method: "BCa", "t", "constant" (all values the same) or "none" (fewer than two values)."""

    low: float
    high: float
    method: str


NO_INTERVAL = Interval(math.nan, math.nan, "none")


def least_count(confidence: float) -> int:
    """Smallest n with 1 - 2^(1-n) >= confidence: the range of n values then contains the median."""
    return math.ceil(1 - math.log2(1 - confidence) - 1e-9)


def student(confidence: float, degrees: float) -> float:
    """Quantile of Student's t, two-sided."""
    return float(stdtrit(degrees, (1 + confidence) / 2))


def mean_interval(values: np.ndarray, confidence: float = 0.95, *, least: float = -math.inf, seed: int = 0) -> Interval:
    """Interval of the mean of `values`, (n,). least: lower bound of the mean (0 for an error)."""
    limits = _mean_interval(np.asarray(values, float).tobytes(), confidence, seed)
    return limits._replace(low=max(limits.low, least))


@functools.lru_cache(maxsize=4096)  # the flights of one contestant are often the common flights
def _mean_interval(data: bytes, confidence: float, seed: int) -> Interval:
    values = np.frombuffer(data)
    mean = float(np.mean(values)) if len(values) else math.nan
    return _interval((values,), lambda x, axis=-1: np.mean(x, axis=axis), mean, values, abs(mean), confidence, seed)


def reduction_interval(
    values: np.ndarray, baseline: np.ndarray, confidence: float = 0.95, *, seed: int = 0
) -> Interval:
    """Interval of 100 (1 - mean values / mean baseline) (%) over pairs, both (n,), baseline with a mean above zero.

    t: by the delta method, with z_i = x_i - (mean x / mean b) b_i in place of x_i.
    """
    values, baseline = np.asarray(values, float), np.asarray(baseline, float)
    if not len(values) or not np.mean(baseline) > 0:
        return NO_INTERVAL

    def reduction(x: np.ndarray, b: np.ndarray, axis: int = -1) -> np.ndarray:
        return 100 * (1 - np.mean(x, axis=axis) / np.mean(b, axis=axis))

    ratio = float(np.mean(values) / np.mean(baseline))
    linear = 100 * (values - ratio * baseline) / float(np.mean(baseline))
    return _interval((values, baseline), reduction, 100 * (1 - ratio), linear, 100.0, confidence, seed)


def _interval(
    samples: tuple[np.ndarray, ...], statistic: Callable[..., Any], value: float, linear: np.ndarray, scale: float,
    confidence: float, seed: int,
) -> Interval:  # fmt: skip
    """Interval of a statistic with this value. linear: its linear part, (n,), for t. scale: of linear."""
    n = len(linear)
    if n < 2:
        return NO_INTERVAL
    if np.ptp(linear) <= SAME * scale:
        return Interval(value, value, "constant")
    half = student(confidence, n - 1) * float(np.std(linear, ddof=1)) / math.sqrt(n)
    return _bootstrap(samples, statistic, confidence, seed) or Interval(value - half, value + half, "t")


class Ratio(NamedTuple):
    """Ratio of two errors over conditions, its limits and the p of a ratio of one; NaN where there is none."""

    value: float
    low: float
    high: float
    p: float


def log_ratio(logs: Sequence[np.ndarray], confidence: float = 0.95, *, across: bool = False) -> Ratio:
    """The mean ratio over conditions, each with the same weight. logs: ln(x / b) of the pairs of each condition.

    Limits and p are for new seeds of these conditions. If a condition has one pair only, they are NaN, or, with
    `across`, those of the means of the conditions as a sample, which are wider.
    """
    logs = [np.asarray(log, float) for log in logs if len(log)]
    if not logs:
        return Ratio(math.nan, math.nan, math.nan, math.nan)
    means = np.array([np.mean(log) for log in logs])
    mean, count = float(np.mean(means)), len(logs)
    if all(len(log) > 1 for log in logs):
        variances = np.array([np.var(log, ddof=1) / len(log) for log in logs])
        degrees_of_each = np.array([len(log) - 1.0 for log in logs])
    elif across and count > 1:
        variances, degrees_of_each, count = np.array([np.var(means, ddof=1) / count]), np.array([count - 1.0]), 1
    else:
        return Ratio(math.exp(mean), math.nan, math.nan, math.nan)
    error = math.sqrt(float(variances.sum())) / count
    largest = max(float(np.abs(log).max()) for log in logs)
    if error <= SAME * max(largest, 1.0):  # every pair has the same ratio
        p = 1.0 if abs(mean) <= SAME * max(largest, 1.0) else 0.0
        return Ratio(math.exp(mean), math.exp(mean), math.exp(mean), p)
    degrees = float(variances.sum()) ** 2 / float(np.sum(variances**2 / degrees_of_each))
    half = student(confidence, degrees) * error
    p = 2 * float(stdtr(degrees, -abs(mean) / error))
    return Ratio(math.exp(mean), math.exp(mean - half), math.exp(mean + half), p)


def widened(confidence: float, n: int) -> float:
    """Confidence at which a bootstrap of n values has the width of a t interval."""
    return 1 - 2 * float(ndtr(-math.sqrt(n / (n - 1)) * student(confidence, n - 1)))


def _bootstrap(
    samples: tuple[np.ndarray, ...], statistic: Callable[..., Any], confidence: float, seed: int
) -> Interval | None:
    """BCa limits, or None for too few or too many values, or where BCa is not defined."""
    n = len(samples[0])
    if not least_count(confidence) <= n <= MOST_BOOTSTRAPPED:
        return None
    from scipy.stats import bootstrap

    result = bootstrap(
        samples, statistic, paired=len(samples) > 1, vectorized=True, axis=-1, n_resamples=RESAMPLES, method="BCa",
        confidence_level=widened(confidence, n), random_state=np.random.default_rng(seed),
    ).confidence_interval  # fmt: skip
    low, high = float(result.low), float(result.high)
    return Interval(low, high, "BCa") if math.isfinite(low) and math.isfinite(high) else None


@functools.lru_cache(maxsize=4096)
def success_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's limits of a share; NaN without trials."""
    if trials == 0:
        return math.nan, math.nan
    share, z = successes / trials, float(ndtri(0.5 + 0.5 * confidence))
    scale = 2 * (trials + z**2)
    centre = (2 * trials * share + z**2) / scale
    half = z / scale * math.sqrt(4 * trials * share * (1 - share) + z**2)
    return 0.0 if successes == 0 else centre - half, 1.0 if successes == trials else centre + half


def paired_permutation(differences: np.ndarray, *, seed: int = 0) -> float:
    """Two-sided p of the hypothesis that each difference has either sign equally often, (n,); NaN without differences.

    Exact up to 30 pairs; beyond by 99,999 drawn patterns, (1 + hits) / (1 + draws); beyond 200 by the normal limit.
    """
    differences = np.asarray(differences, float)
    n = len(differences)
    if n == 0:
        return math.nan
    differences = differences / (float(np.abs(differences).sum()) or 1.0)
    observed = abs(float(differences.sum())) - SAME
    if observed <= 0:
        return 1.0
    if n > MOST_DRAWN:
        return 2 * float(ndtr(-observed / math.sqrt(float(np.sum(differences**2)))))
    if n > MOST_EXACT:
        from scipy.stats import monte_carlo_test

        rng = np.random.default_rng(seed)
        drawn = monte_carlo_test(
            differences,
            lambda size: differences * rng.choice((-1.0, 1.0), size=size),
            lambda x, axis: np.abs(np.sum(x, axis=axis)),
            n_resamples=DRAWS, alternative="greater", vectorized=True, batch=BATCH,
        )  # fmt: skip
        return float(drawn.pvalue)
    # Sums over the sign patterns of each half of the pairs; every pattern of all is one of either half.
    left, right = _signed_sums(differences[: n // 2]), np.sort(_signed_sums(differences[n // 2 :]))
    above = len(right) * len(left) - int(np.searchsorted(right, observed - left, side="left").sum())
    return 2 * above / 2.0**n


def _signed_sums(values: np.ndarray) -> np.ndarray:
    """Sum of the values for every pattern of signs, (2^n,)."""
    return functools.reduce(lambda sums, value: np.concatenate([sums - value, sums + value]), values, np.zeros(1))


def least_p(n: int) -> float:
    """The smallest p that n pairs can give: two of 2^n patterns."""
    return 2.0 ** (1 - n) if n > 0 else math.nan


def rank_biserial(differences: np.ndarray) -> float:
    """Matched-pairs rank-biserial correlation in [-1, 1]: 1 where every difference is negative.

    Differences of zero are left out; NaN without any difference."""
    differences = np.asarray(differences, float)
    if len(differences) == 0:
        return math.nan
    differences = differences[differences != 0]
    _, place, counts = np.unique(np.abs(differences), return_inverse=True, return_counts=True)
    rank = (np.cumsum(counts) - (counts - 1) / 2)[place]  # equal differences share the mean of their ranks
    return float(-np.sum(np.sign(differences) * rank) / np.sum(rank)) if len(differences) else 0.0


def cohen_d(differences: np.ndarray) -> float:
    """Mean over standard deviation of the paired differences, with the sign of -mean; NaN where it is not defined."""
    differences = np.asarray(differences, float)
    if len(differences) < 2 or np.ptp(differences) <= SAME * np.abs(differences).max():
        return math.nan
    return float(-np.mean(differences) / np.std(differences, ddof=1))


def holm(p: np.ndarray) -> np.ndarray:
    """p-values corrected by Holm's step-down procedure, (m,); NaN stays NaN and does not count."""
    p = np.asarray(p, float)
    adjusted = np.full(p.shape, math.nan)
    known = np.flatnonzero(~np.isnan(p))
    order = known[np.argsort(p[known], kind="stable")]
    factors = len(order) - np.arange(len(order))
    adjusted[order] = np.maximum.accumulate(np.minimum(1.0, factors * p[order]))
    return adjusted
