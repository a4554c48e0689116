"""Intervals, effects and tests against enumeration, hand-worked numbers, scipy, and coverage on synthetic data."""

import itertools
import math

import numpy as np
import pytest
import scipy.stats

from quadexp.report import inference
from quadexp.report.inference import (
    holm,
    mean_interval,
    paired_permutation,
    rank_biserial,
    reduction_interval,
    success_interval,
)


def enumerated_p(differences):
    sums = [
        abs(sum(s * d for s, d in zip(signs, differences, strict=True)))
        for signs in itertools.product((-1, 1), repeat=len(differences))
    ]
    observed = abs(sum(differences))
    return sum(value >= observed - 1e-12 for value in sums) / len(sums)


class TestInterval:
    def test_few_values_have_students_interval(self):
        values = np.array([3.0, 5.0, 4.0])  # mean 4, s 1, t(0.975, 2) = 4.302653
        low, high, method = mean_interval(values)
        assert method == "t"
        assert (low, high) == pytest.approx((4 - 4.302653 / math.sqrt(3), 4 + 4.302653 / math.sqrt(3)), rel=1e-6)

    def test_two_values_and_one(self):
        low, high, method = mean_interval(np.array([1.0, 2.0]))
        assert method == "t" and high - 1.5 == pytest.approx(12.7062 / 2, rel=1e-5)  # t(0.975, 1) s / sqrt(2)
        assert mean_interval(np.array([1.0, 2.0]), least=0.0).low == 0.0
        for values in ([], [7.0]):
            limits = mean_interval(np.array(values))
            assert math.isnan(limits.low) and math.isnan(limits.high) and limits.method == "none"

    def test_values_that_are_all_the_same(self):
        assert mean_interval(np.full(8, 0.1)).method == "none"  # copies of one value are no sample

    @pytest.mark.parametrize("n", [2, 3, 6, 20])
    @pytest.mark.parametrize(("name", "mean", "least"), [("normal", 0.0, 0.94), ("exponential", 1.0, 0.80)])
    def test_coverage(self, name, mean, least, n):
        draws = getattr(np.random.default_rng(17), name)(size=(2000, n))
        held = [low <= mean <= high for low, high, _ in map(mean_interval, draws)]
        assert least <= np.mean(held) <= 0.965

    @pytest.mark.parametrize("n", [4, 8])
    def test_coverage_of_the_reduction(self, n):
        rng = np.random.default_rng(23)
        runs, held = 2000, 0
        for _ in range(runs):
            common = rng.normal(size=n)  # paired: the same noise in both
            own, base = 5 + 0.3 * common + 0.2 * rng.normal(size=n), 20 + common + 0.4 * rng.normal(size=n)
            low, high, _ = reduction_interval(own, base)
            held += low <= 75.0 <= high
        assert 0.93 <= held / runs <= 0.97

    def test_a_reduction_that_is_the_same_everywhere(self):
        base = np.array([10.0, 20.0, 40.0])
        assert reduction_interval(0.25 * base, base).method == "none"
        assert reduction_interval(base, np.zeros(3)).method == "none"


class TestSuccess:
    @pytest.mark.parametrize(("k", "n"), [(0, 5), (3, 5), (5, 5), (17, 20)])
    def test_limits_as_scipy_has_them(self, k, n):
        wanted = scipy.stats.binomtest(k, n).proportion_ci(0.95, method="exact")
        assert success_interval(k, n) == pytest.approx((wanted.low, wanted.high), rel=1e-9, abs=1e-12)

    def test_no_trials(self):
        assert all(map(math.isnan, success_interval(0, 0)))


class TestPermutation:
    @pytest.mark.parametrize("n", [1, 2, 3, 5, 8, 11])
    def test_it_is_the_enumeration(self, n):
        rng = np.random.default_rng(n)
        for shift in (0.0, 0.5, 3.0):
            differences = rng.normal(shift, 1.0, n)
            assert paired_permutation(differences) == enumerated_p(differences)

    def test_ties_count(self):
        # Sums of +-1 +-1 +-2 are at least 2 in size for 6 of 8 patterns (all but 1-1... of which: +-(1+1-2) = 0).
        assert paired_permutation([1.0, -1.0, 2.0]) == enumerated_p([1, -1, 2]) == 6 / 8
        assert paired_permutation([0.1, 0.2, -0.3]) == 1.0  # 0.1 + 0.2 - 0.3 is not zero in floating point
        assert paired_permutation(np.zeros(4)) == 1.0 and math.isnan(paired_permutation([]))

    def test_all_of_one_sign_has_the_least_p(self):
        for n in (2, 5, 9, 14):
            assert paired_permutation(-np.arange(1.0, n + 1)) == 2 / 2**n
        assert paired_permutation(-np.arange(1.0, 31)) == 1 / inference.PATTERNS  # of drawn patterns

    def test_drawn_patterns_agree_with_all(self):
        differences = np.random.default_rng(13).normal(0.3, 1, 18)
        exact = enumerated_p(differences)
        assert 0.01 < exact < 0.5
        assert abs(paired_permutation(differences) - exact) < 4 * math.sqrt(exact / inference.PATTERNS)

    def test_it_errs_as_often_as_it_says(self):
        rng = np.random.default_rng(19)
        p = np.array([paired_permutation(rng.standard_t(3, 7)) for _ in range(2000)])
        for alpha in (0.05, 0.2):
            assert np.mean(p <= alpha) <= alpha + 3 * math.sqrt(alpha * (1 - alpha) / 2000)


class TestEffect:
    def test_rank_biserial_by_hand(self):
        # Ranks of 3, 1, 2, 4 are themselves; negative ones sum to 8, the positive one is 2: (8 - 2) / 10.
        assert rank_biserial([-3.0, -1.0, 2.0, -4.0]) == pytest.approx(0.6)
        assert rank_biserial([-1.0, 1.0, 0.0]) == 0.0  # a tie; zero takes no part
        assert rank_biserial([-1.0, -2.0]) == 1.0 and rank_biserial([3.0]) == -1.0
        assert rank_biserial([0.0]) == 0.0 and math.isnan(rank_biserial([]))

    def test_rank_biserial_from_wilcoxons_statistic(self):
        differences = np.random.default_rng(2).integers(-6, 5, 15).astype(float)
        differences = differences[differences != 0]
        n = len(differences)
        plus = scipy.stats.wilcoxon(differences, alternative="greater", method="asymptotic").statistic
        assert rank_biserial(differences) == pytest.approx(1 - 4 * plus / (n * (n + 1)))


class TestHolm:
    def test_by_hand(self):
        # 4 x 0.005, 3 x 0.01, 2 x 0.03, and 1 x 0.04 raised to its predecessor's 0.06.
        assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])

    def test_never_above_one_and_nan_does_not_count(self):
        adjusted = holm([0.6, math.nan, 0.5])
        assert adjusted[[0, 2]] == pytest.approx([1.0, 1.0]) and math.isnan(adjusted[1])
        assert holm([0.02, math.nan])[0] == 0.02 and len(holm([])) == 0
