"""Intervals, effect sizes and tests of a few independent values, one a seed (pairing.py). Arrays in, numbers out.

With n values x_i, mean m, standard deviation s, confidence 1 - alpha, and paired differences d_i = x_i - b_i:

    mean       m +- t s / sqrt(n), Student's t with n - 1 degrees of freedom
    reduction  100 (1 - mean x / mean b), the same with x_i - (mean x / mean b) b_i in place of x_i (delta method)
    ratio      exp(m), exp(m +- t s / sqrt(n)) of x_i = ln of a ratio; its p is that of m = 0 by the t test
    share      q of Beta at alpha / 2 and 1 - alpha / 2                (Clopper & Pearson 1934, Biometrika 26(4))
    p          share of the 2^n sign patterns g with |sum g_i d_i| >= |sum d_i|  (Fisher 1935, Design of Experiments)
    effect     (R- - R+) / (R- + R+), R the rank sums of |d_i| by sign of d_i    (Kerby 2014, Compr. Psychol. 3)
    Holm       p_(i) -> max over j <= i of min(1, (m - j + 1) p_(j))             (Holm 1979, Scand. J. Stat. 6(2))

Values that are all the same are copies of one flight, of which a seed changes nothing: they have no interval and no p.

The permutation test needs no distribution: it holds its level for every n, and cannot give less than 2^(1-n), so that
`least_seeds` says how many can show a difference at all. Unlike Wilcoxon's, it tests the difference of means that the
tables show. Student's t holds its level for normal values; for a skewed error such as exp(normal / 2) the 95 % interval
of 6 to 20 values contains the mean in 92 to 93 % of the cases, and a bootstrap (BCa, widened to t's level) does no
better. Paired flights have the same noise, so Cohen's d reaches hundreds; the rank-biserial effect is bounded.

The few lines of each are written here, because importing scipy.stats takes as long as a dozen flights.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from scipy.special import betaincinv, ndtr, stdtr, stdtrit

MOST_EXACT = 30  # values whose 2^n sign patterns are counted; beyond, their sum is normal
SAME = 1e-12  # relative difference below which two sums are one


class Interval(NamedTuple):
    """Confidence limits. method: "t", or "none": fewer than two values, or all the same."""

    low: float = math.nan
    high: float = math.nan
    method: str = "none"


NO_INTERVAL = Interval()


def vary(values: np.ndarray) -> bool:
    """Whether values (n,) differ: those of several seeds that do not are copies of one flight."""
    return len(values) > 1 and bool(np.ptp(values) > SAME * np.abs(values).max())


def mean_interval(values: np.ndarray, confidence: float = 0.95, *, least: float = -math.inf) -> Interval:
    """Interval of the mean of `values`, (n,). least: lower bound of the mean (0 for an error)."""
    values = np.asarray(values, float)
    if not vary(values):
        return NO_INTERVAL
    n, mean = len(values), float(np.mean(values))
    half = float(stdtrit(n - 1, (1 + confidence) / 2)) * float(np.std(values, ddof=1)) / math.sqrt(n)
    return Interval(max(mean - half, least), mean + half, "t")


def reduction_interval(values: np.ndarray, baseline: np.ndarray, confidence: float = 0.95) -> Interval:
    """Interval of 100 (1 - mean values / mean baseline) (%) over pairs, both (n,), baseline with a mean above zero."""
    values, baseline = np.asarray(values, float), np.asarray(baseline, float)
    if not len(values) or not np.mean(baseline) > 0:
        return NO_INTERVAL
    base = float(np.mean(baseline))
    ratio = float(np.mean(values)) / base
    about_100 = 100 + 100 * (values - ratio * baseline) / base  # their mean is 100, by which `vary` judges
    low, high, method = mean_interval(about_100, confidence)
    return Interval(low - 100 * ratio, high - 100 * ratio, method)


class Ratio(NamedTuple):
    """Ratio of two errors, its limits and the p of a ratio of one; NaN where there is none."""

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan
    p: float = math.nan


NO_RATIO = Ratio()


def log_ratio(logs: np.ndarray, confidence: float = 0.95) -> Ratio:
    """The mean ratio over seeds. logs: ln of the ratio of every seed, (n,)."""
    logs = np.asarray(logs, float)
    if not len(logs):
        return NO_RATIO
    mean, (low, high, method) = float(np.mean(logs)), mean_interval(logs, confidence)
    if method == "none":
        return Ratio(math.exp(mean))
    statistic = abs(mean) / float(np.std(logs, ddof=1)) * math.sqrt(len(logs))
    return Ratio(math.exp(mean), math.exp(low), math.exp(high), 2 * float(stdtr(len(logs) - 1, -statistic)))


@functools.lru_cache(maxsize=4096)
def success_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Limits of a share of independent trials; NaN without trials."""
    if trials == 0:
        return math.nan, math.nan
    tail = (1 - confidence) / 2
    low = float(betaincinv(successes, trials - successes + 1, tail)) if successes > 0 else 0.0
    high = float(betaincinv(successes + 1, trials - successes, 1 - tail)) if successes < trials else 1.0
    return low, high


def paired_permutation(differences: np.ndarray) -> float:
    """Two-sided p of the hypothesis that each difference has either sign equally often, (n,); NaN without differences.

    Exact up to 30 values; beyond by the normal limit.
    """
    differences = np.asarray(differences, float)
    n = len(differences)
    if n == 0:
        return math.nan
    differences = differences / (float(np.abs(differences).sum()) or 1.0)
    observed = abs(float(differences.sum())) - SAME
    if observed <= 0:
        return 1.0
    if n > MOST_EXACT:
        return 2 * float(ndtr(-observed / math.sqrt(float(np.sum(differences**2)))))
    # Sums over the sign patterns of each half of the pairs; every pattern of all is one of either half.
    left, right = _signed_sums(differences[: n // 2]), np.sort(_signed_sums(differences[n // 2 :]))
    above = len(right) * len(left) - int(np.searchsorted(right, observed - left, side="left").sum())
    return 2 * above / 2.0**n


def _signed_sums(values: np.ndarray) -> np.ndarray:
    """Sum of the values for every pattern of signs, (2^n,)."""
    return functools.reduce(lambda sums, value: np.concatenate([sums - value, sums + value]), values, np.zeros(1))


def least_p(n: int) -> float:
    """The smallest p that n values can give: two of 2^n patterns."""
    return 2.0 ** (1 - n) if n > 0 else math.nan


def least_seeds(comparisons: int, confidence: float = 0.95) -> int:
    """The smallest n that can show a difference: least_p(n) < 1 - confidence, over so many comparisons."""
    return math.floor(2 + math.log2(comparisons / (1 - confidence)) + 1e-9)


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


def holm(p: np.ndarray) -> np.ndarray:
    """p-values corrected by Holm's step-down procedure, (m,); NaN stays NaN and does not count."""
    p = np.asarray(p, float)
    adjusted = np.full(p.shape, math.nan)
    known = np.flatnonzero(~np.isnan(p))
    order = known[np.argsort(p[known], kind="stable")]
    factors = len(order) - np.arange(len(order))
    adjusted[order] = np.maximum.accumulate(np.minimum(1.0, factors * p[order]))
    return adjusted
