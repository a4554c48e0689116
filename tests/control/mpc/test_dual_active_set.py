"""The dual active set by itself: random bounded quadratic minima, ill-conditioned and degenerate, against qpOASES."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from quadexp.control.mpc.dual_active_set import Bounded, bounded_minimum

SIZE = 24


def problem(rng: np.random.Generator, condition: float) -> tuple[np.ndarray, np.ndarray]:
    """H of that condition number, and where the minimum without bounds is."""
    turn = np.linalg.qr(rng.normal(size=(SIZE, SIZE)))[0]
    return turn @ np.diag(condition ** rng.uniform(-1, 0, SIZE)) @ turn.T, 3 * rng.normal(size=SIZE)


def solve(H, start, low, high, guess) -> Bounded:
    inverse = np.linalg.inv(H)
    return bounded_minimum((inverse + inverse.T) / 2, start, low, high, guess, lambda u: H @ (u - start))


def qpoases(H, start, low, high) -> np.ndarray:
    shape = {"h": ca.Sparsity.dense(SIZE, SIZE), "a": ca.Sparsity(0, SIZE)}
    solver = ca.conic("dense", "qpoases", shape, {"printLevel": "none", "error_on_fail": True})
    return solver(h=H, g=-H @ start, lbx=low, ubx=high)["x"].full().ravel()


@pytest.mark.parametrize("condition", [1.0, 1e2, 1e5])
def test_random_minima(rng, condition):
    """Boxes of any place and width, some of no width and some without a bound, from any guess."""
    for trial in range(40):
        H, start = problem(rng, condition)
        low = start + 2 * rng.normal(size=SIZE)
        high = low + rng.choice([0.0, 0.1, 5.0], SIZE)
        low[rng.uniform(size=SIZE) < 0.1] = -np.inf
        high[rng.uniform(size=SIZE) < 0.1] = np.inf
        guess = rng.integers(-1, 2, SIZE).astype(float) if trial % 2 else np.zeros(SIZE)
        guess[np.isinf(low) & (guess < 0) | np.isinf(high) & (guess > 0)] = 0
        found = solve(H, start, low, high, guess)
        assert found.solved and found.exchanges <= 10 * SIZE
        assert np.abs(found.u - qpoases(H, start, np.maximum(low, -1e5), np.minimum(high, 1e5))).max() < 1e-8
        assert np.all(found.u[found.side > 0] == high[found.side > 0])
        assert np.all(found.u[found.side < 0] == low[found.side < 0])
        force = -H @ (found.u - start)
        free = (found.side == 0) & (low < high)
        assert np.abs(force[free]).max(initial=0.0) < 1e-9
        assert np.all((force * found.side)[low < high] > -1e-9)


def test_every_input_at_a_corner(rng):
    """Bounds far below the minimum without bounds, H diagonal: all at the upper bound, one exchange each."""
    start, low, high = np.full(SIZE, 10.0), np.full(SIZE, -1.0), np.full(SIZE, 1.0)
    found = solve(np.diag(rng.uniform(1, 2, SIZE)), start, low, high, np.zeros(SIZE))
    assert found.exchanges == SIZE and np.all(found.u == high) and np.all(found.side == 1)


def test_two_inputs_by_hand():
    """H = [[2, 1], [1, 2]], minimum at (3, 0), u_0 <= 1: then 2 u_1 = -(u_0 - 3), so u_1 = 1, or its bound 0.5."""
    H, start, low = np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([3.0, 0.0]), np.array([-9.0, -9.0])
    for top, expected, side in ((9.0, [1.0, 1.0], [1, 0]), (0.5, [1.0, 0.5], [1, 1])):
        found = solve(H, start, low, np.array([1.0, top]), np.zeros(2))
        assert found.u == pytest.approx(expected, abs=1e-12) and np.array_equal(found.side, side)


@pytest.mark.parametrize("where", ["inverse", "start"])
def test_a_number_that_is_none_is_not_solved(rng, where):
    H, start = problem(rng, 10.0)
    inverse = np.linalg.inv(H)
    (inverse if where == "inverse" else start)[3] = np.nan
    with np.errstate(all="ignore"):
        found = bounded_minimum(
            inverse, start, start - 1, start + 1, np.zeros(SIZE), lambda u: H @ (u - np.zeros(SIZE))
        )
    assert not found.solved
