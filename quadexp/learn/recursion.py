"""Recursive least squares over regressors of any meaning, in square-root information form (Bierman 1977).

With R'R = sum x x' and z = R c, a packet of rows X, y turns the triangle by one QR step,

    Q [ sqrt(lambda) R  sqrt(lambda) z ]   =   [ R+  z+ ]        c+ = R+^-1 z+
      [       X               y        ]       [ 0   e  ]

which is RLS without a prior: the estimate after k rows IS the least-squares fit of the first k rows, to rounding, and
there is none before the rows tell the coefficients apart. (RLS with a prior P_0: quadexp.learn.rls.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.errors import UsageError
from quadexp.learn.regression import Regression

MOST_ESTIMATES = 2000  # of one series; longer data go in packets of several rows
LEAST_PIVOT = 1e-6  # of R at unit columns, below which the rows so far do not tell the coefficients apart


@dataclass(frozen=True)
class Recursion:
    """Estimates over the rows. row: (m,), index of the last row each has seen. names: (p,).

    coefficients: (m, p), NaN where there is none yet. errors: (m, p), standard errors.
    """

    names: tuple[str, ...]
    row: np.ndarray
    coefficients: np.ndarray
    errors: np.ndarray


def recurse(design: np.ndarray, target: np.ndarray, batch: Regression, *, forgetting: float = 1.0) -> Recursion:
    """Run through design (n, p) and target (n,) in their order.

    batch: the fit of the same rows; what its standard errors exceed those of independent errors by, these are widened
    by too, so that the band ends where the batch's interval is. forgetting: lambda per row, 1 forgets nothing.
    """
    if not 0.5 <= forgetting <= 1:
        raise UsageError(f"identify: forgetting {forgetting:g} is outside [0.5, 1]")
    n, p = design.shape
    length = np.linalg.norm(design, axis=0)
    rows = np.column_stack([design / length, target])
    packet = -(-n // MOST_ESTIMATES)
    ends = np.r_[np.arange(packet, n, packet), n]
    widening = batch.errors / np.sqrt(np.diag(batch.plain))
    triangle = np.zeros((p + 1, p + 1))
    coefficients, errors = np.full((2, len(ends), p), np.nan)
    start = 0
    for k, end in enumerate(ends):
        kept = np.sqrt(forgetting ** (end - start)) * triangle
        triangle = np.asarray(np.linalg.qr(np.vstack([kept, rows[start:end]]), mode="r"))[: p + 1]
        triangle = np.vstack([triangle, np.zeros((p + 1 - len(triangle), p + 1))])
        start = end
        root = triangle[:p, :p]
        if end <= p or np.abs(np.diag(root)).min() < LEAST_PIVOT * np.sqrt(end / n):
            continue
        inverse = np.linalg.inv(root)
        coefficients[k] = inverse @ triangle[:p, p] / length
        scale = abs(triangle[p, p]) / np.sqrt(end - p)
        errors[k] = scale * np.sqrt(np.sum(inverse**2, axis=1)) / length * widening
    return Recursion(batch.names, ends - 1, coefficients, errors)
