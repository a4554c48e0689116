"""Functions sampled on a regular grid of times: derivatives, integrals and interpolation.

Derivatives at the nodes by fourth-order differences on five nodes (one-sided at the ends),

    f'  = (f_-2 - 8 f_-1 + 8 f_1 - f_2) / (12 h)                + O(h^4)
    f'' = (-f_-2 + 16 f_-1 - 30 f_0 + 16 f_1 - f_2) / (12 h^2)  + O(h^4)

between the nodes by the quintic through the six nearest. Integrals by the trapezoidal rule with end correction,
h (f_0 + f_1) / 2 + h^2 (f'_0 - f'_1) / 12 + O(h^5) per step. Arrays are component first: (d, n) at n nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np

SPACING = 0.01  # s, largest distance of nodes
MARGIN = 3  # nodes added on both sides of the times of interest, within the allowed range
MIN_STEPS = 8  # least number of steps of a grid


def _difference_weights(order: int, width: int) -> np.ndarray:
    """W (width, width): f^(order) at node i is sum_j W_ij f_j, for unit node distance."""
    offsets = np.arange(width) - np.arange(width)[:, None]
    powers = offsets[:, None, :] ** np.arange(width)[None, :, None]
    return np.linalg.solve(powers.astype(float), factorial(order) * np.eye(width)[order][None, :, None])[..., 0]


_WIDTH = 5  # points of a difference of fourth order
_FIRST = _difference_weights(1, _WIDTH)
_SECOND = _difference_weights(2, _WIDTH)
_QUINTIC = np.linalg.inv(np.vander(np.arange(6.0), increasing=True))  # values at 0 .. 5 -> coefficients


@dataclass(frozen=True)
class TimeGrid:
    """Nodes `times`, (n,) s, `spacing` apart (s)."""

    times: np.ndarray
    spacing: float

    @classmethod
    def around(cls, first: float, last: float, low: float, high: float) -> TimeGrid:
        """A grid over first .. last with a margin, within low .. high (s)."""
        return cls.over(max(first - MARGIN * SPACING, low), min(last + MARGIN * SPACING, high), SPACING)

    @classmethod
    def over(cls, first: float, last: float, spacing: float) -> TimeGrid:
        """A grid from first to last (s), its nodes at most `spacing` apart (s)."""
        steps = max(int(np.ceil((last - first) / spacing - 1e-9)), MIN_STEPS)
        return cls(np.linspace(first, last, steps + 1), (last - first) / steps)

    def coarse(self) -> TimeGrid:
        """A grid with a quarter of the nodes over the same times."""
        return TimeGrid.over(self.times[0], self.times[-1], 4 * self.spacing)

    def differentiate(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First and second time derivative at the nodes, (d, n) each, of values (d, n)."""
        return _apply(_FIRST, values) / self.spacing, _apply(_SECOND, values) / self.spacing**2

    def integrate(self, values: np.ndarray, derivative: np.ndarray) -> np.ndarray:
        """Integral from the first node to each node, (n,), of values (n,) with time derivative (n,)."""
        steps = (values[:-1] + values[1:]) / 2 + self.spacing / 12 * (derivative[:-1] - derivative[1:])
        return np.concatenate([[0.0], self.spacing * np.cumsum(steps)])

    def interpolate(self, values: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Value, first and second time derivative at the times t, (k,) (s), of values (d, n): (d, k) each."""
        place = (t - self.times[0]) / self.spacing
        first = np.clip(np.floor(place).astype(int) - 2, 0, len(self.times) - 6)
        s = place - first
        coefficients = np.einsum("ij,djk->dik", _QUINTIC, values[:, first + np.arange(6)[:, None]])
        power = np.arange(6)[:, None]
        monomials = s**power
        slope = np.zeros_like(monomials)
        bend = np.zeros_like(monomials)
        slope[1:] = power[1:] * monomials[:-1]
        bend[2:] = power[2:] * power[1:-1] * monomials[:-2]
        return (
            np.einsum("ik,dik->dk", monomials, coefficients),
            np.einsum("ik,dik->dk", slope, coefficients) / self.spacing,
            np.einsum("ik,dik->dk", bend, coefficients) / self.spacing**2,
        )


def _apply(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Apply weights (5, 5) to values (d, n): central differences inside, one-sided at the two outer nodes."""
    n = values.shape[1]
    half = _WIDTH // 2
    result = np.empty_like(values)
    result[:, half : n - half] = sum(weights[half, j] * values[:, j : n - _WIDTH + 1 + j] for j in range(_WIDTH))
    result[:, :half] = values[:, :_WIDTH] @ weights[:half].T
    result[:, n - half :] = values[:, -_WIDTH:] @ weights[-half:].T
    return result
