"""Recursive estimates against the least squares of the same rows."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.learn.recursion import MOST_ESTIMATES, recurse
from quadexp.learn.regression import regress


def problem(rng, n=900, p=4):
    design = rng.normal(size=(n, p)) * [1.0, 30.0, 0.01, 1.0][:p]
    target = design @ np.array([0.4, 0.02, 5.0, 0.1])[:p] + 0.1 * rng.normal(size=n)
    flight = np.zeros(n, int)
    return design, target, regress(design, target, tuple("abcd"[:p]), flight, flight, what="x")


def test_ends_at_the_batch_estimate_and_its_interval(rng):
    design, target, batch = problem(rng)
    series = recurse(design, target, batch)
    assert series.coefficients[-1] == pytest.approx(batch.coefficients, rel=1e-8)
    assert series.errors[-1] == pytest.approx(batch.errors, rel=1e-8)
    assert series.row[-1] == 899 and series.coefficients.shape == (900, 4)


@pytest.mark.parametrize("k", [5, 60, 500])
def test_is_least_squares_of_the_rows_so_far(rng, k):
    design, target, batch = problem(rng)
    series = recurse(design, target, batch)
    at = int(np.flatnonzero(series.row == k - 1)[0])
    assert series.coefficients[at] == pytest.approx(np.linalg.lstsq(design[:k], target[:k])[0], rel=1e-8)


def test_no_estimate_before_the_rows_determine_all_coefficients(rng):
    design, target, _ = problem(rng, p=2)
    design[:300, 1] = design[:300, 0]
    flight = np.zeros(len(target), int)
    batch = regress(design, target, ("a", "b"), flight, flight, what="x")
    series = recurse(design, target, batch)
    assert np.isnan(series.coefficients[:299]).all() and np.isfinite(series.coefficients[310:]).all()


def test_long_data_go_in_batches_and_end_alike(rng):
    design, target, batch = problem(rng, n=3 * MOST_ESTIMATES + 17)
    series = recurse(design, target, batch)
    assert len(series.row) <= MOST_ESTIMATES and series.row[-1] == len(target) - 1
    assert series.coefficients[-1] == pytest.approx(batch.coefficients, rel=1e-8)
