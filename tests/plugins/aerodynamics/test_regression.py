"""Regression whose intervals hold although neighbouring samples err alike."""

import numpy as np
import pytest

from quadexp.errors import DataError
from quadexp.plugins.aerodynamics.blocks import FLIGHT_CLUSTERS, MOST_LAGS, autocorrelation_time, regress
from tests.models.logged_flights import coloured

TRUTH = np.array([0.4, 0.05])


def draw(rng, flights=2, n=1500, memory=25.0, spread=0.0):
    """A drag line with coloured errors; spread: standard deviation of the slope between flights."""
    design, target, flight = [], [], []
    for k in range(flights):
        v = np.sin(np.arange(n) * 0.021 + rng.uniform(0, 6)) + 0.2 * coloured(rng, n, 30)
        slope = TRUTH[0] + spread * rng.normal()
        design.append(np.column_stack([-v, np.ones(n)]))
        target.append(-slope * v + TRUTH[1] + 0.08 * coloured(rng, n, memory))
        flight.append(np.full(n, k))
    return np.concatenate(design), np.concatenate(target), np.concatenate(flight)


def covered(rng, repeats=200, **options):
    """Share of repetitions whose 95 % interval holds the truth: of the module's, and of independent errors."""
    found = np.zeros((2, 2))
    for _ in range(repeats):
        design, target, flight = draw(rng, **options)
        fit = regress(design, target, ("d", "b"), flight, flight, what="line")
        plain = regress(design, target, ("d", "b"), flight, flight, what="line", intervals=False)
        error = np.abs(fit.coefficients - TRUTH)
        found += error < fit.half_width(), error < 1.96 * plain.errors
    return found / repeats


@pytest.mark.parametrize("memory", [0.0, 5.0, 25.0])
def test_intervals_hold_at_their_rate_where_errors_remember(rng, memory):
    ours, plain = covered(rng, memory=memory)
    assert np.all(ours > 0.90) and np.all(ours < 0.99)  # 0.95 +- 0.015 of 200 repetitions, and few blocks
    assert (memory == 0) == bool(np.all(plain > 0.9))
    if memory == 25:
        assert np.all(plain < 0.5)


def test_many_flights_carry_what_differs_between_them(rng):
    ours, plain = covered(rng, flights=FLIGHT_CLUSTERS + 2, n=300, memory=0.0, spread=0.02)
    assert ours[0] > 0.9 and plain[0] < 0.6


def test_white_errors_are_no_wider_than_they_must_be(rng):
    design, target, flight = draw(rng, memory=0.0)
    fit = regress(design, target, ("d", "b"), flight, flight, what="line")
    plain = regress(design, target, ("d", "b"), flight, flight, what="line", intervals=False)
    assert fit.errors == pytest.approx(plain.errors, rel=0.3) and np.array_equal(fit.coefficients, plain.coefficients)


def test_autocorrelation_time_of_a_known_process(rng):
    found = np.mean([autocorrelation_time(coloured(rng, 20000, 20.0)) for _ in range(10)])
    a = np.exp(-1 / 20)
    assert found == pytest.approx((1 + a) / (1 - a), rel=0.1)
    assert autocorrelation_time(np.ones(50)) == 1.0


def test_huber_is_not_bent_by_outliers(rng):
    design, target, flight = draw(rng, memory=0.0)
    target[::100] += 5.0
    squares, huber = (
        regress(design, target, ("d", "b"), flight, flight, what="line", loss=loss) for loss in ("squares", "huber")
    )
    assert abs(huber.coefficients[1] - 0.05) < 0.01 < abs(squares.coefficients[1] - 0.05)


def test_columns_that_cannot_be_told_apart_are_named(rng):
    design, target, flight = draw(rng)
    same = np.column_stack([design, design[:, 0] + 1e-6 * rng.normal(size=len(design))])
    with pytest.raises(DataError, match=r"thrust: d, c cannot be distinguished in these flights \(condition number"):
        regress(same, target, ("d", "b", "c"), flight, flight, what="thrust")
    with pytest.raises(DataError, match="c is zero in all samples"):
        regress(np.column_stack([design, 0 * target]), target, ("d", "b", "c"), flight, flight, what="thrust")
    with pytest.raises(DataError, match="10 samples for 2 coefficients"):
        regress(design[:10], target[:10], ("d", "b"), flight[:10], flight[:10], what="thrust")


def test_blocks_never_cross_a_gap(rng):
    from quadexp.plugins.aerodynamics.blocks import blocks_of

    stretch = np.repeat(np.arange(5), [100, 7, 400, 1, 92])
    groups = blocks_of(rng.normal(size=(600, 2)), stretch, np.zeros(600))
    assert np.all(np.diff(groups) >= 0) and groups[0] == 0
    assert all(len(np.unique(stretch[groups == g])) == 1 for g in np.unique(groups))
    assert np.array_equal(np.unique(groups), np.arange(groups.max() + 1))


def test_memory_of_a_long_series(rng):
    """Gauss-Markov noise of memory m remembers (1 + a) / (1 - a) = 2 m samples; averaging neighbours keeps that."""
    long = coloured(rng, 4 * MOST_LAGS, 500.0)
    assert autocorrelation_time(long) == pytest.approx(1000, rel=0.2)
    assert autocorrelation_time(rng.normal(size=4 * MOST_LAGS)) < 8  # the four averaged are the least
