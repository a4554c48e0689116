"""Recursive least squares for any linear regression, in square-root information form (Bierman 1977).

It shows how the estimates of a fit converge over its samples. With R'R = sum x x' and z = R c, a batch of rows X, y
updates the triangle by one QR factorisation,

    Q [ sqrt(lambda) R  sqrt(lambda) z ]   =   [ R+  z+ ]        c+ = R+^-1 z+
      [       X               y        ]       [ 0   e  ]

This is RLS without a prior: the estimate after k rows equals the least-squares fit of the first k rows to rounding, and
none exists until the rows determine all coefficients. (RLS with a prior P_0: quadexp.learn.rls.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.learn.regression import Regression
from quadexp.learn.samples import Samples
from quadexp.learn.vehicle_model import VehicleModel

MOST_ESTIMATES = 2000  # of one series; longer data are taken in batches of several rows
LEAST_PIVOT = 1e-6  # of R at unit columns; below it the rows so far do not determine all coefficients


@dataclass(frozen=True)
class Recursion:
    """Estimates over the rows. names: (p,). row: (m,), index of the last row that each estimate uses.

    coefficients: (m, p), NaN where not determined yet. errors: (m, p), standard errors.
    """

    names: tuple[str, ...]
    row: np.ndarray
    coefficients: np.ndarray
    errors: np.ndarray


def recurse(design: np.ndarray, target: np.ndarray, batch: Regression) -> Recursion:
    """Estimates from design (n, p) and target (n,), row after row.

    batch: the fit of the same rows. Its ratio of standard errors to those of independent errors scales the errors here,
    so that the last ones equal the batch's.
    """
    n, p = design.shape
    length = np.linalg.norm(design, axis=0)
    rows = np.column_stack([design / length, target])
    batch_size = -(-n // MOST_ESTIMATES)
    ends = np.r_[np.arange(batch_size, n, batch_size), n]
    widening = batch.errors / np.sqrt(np.diag(batch.plain))
    triangle = np.zeros((p + 1, p + 1))
    coefficients, errors = np.full((2, len(ends), p), np.nan)
    start = 0
    for k, end in enumerate(ends):
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, rows[start:end]]), mode="r"))[: p + 1]
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


@dataclass(frozen=True)
class VehicleIdentification:
    """Result of an identification.

    series: model kind -> axis -> recursion. samples: that the series run over. report: JSON-able.
    """

    model: VehicleModel
    samples: Samples
    series: dict[str, dict[str, Recursion]]
    report: dict[str, Any]

    def columns(self) -> dict[str, np.ndarray]:
        """The series of estimates as columns `<model>_<term>_<axis>`, with `std_...` for their standard errors."""
        first = next(iter(next(iter(self.series.values())).values()))
        columns = {"t": elapsed(self.samples)[first.row], "flight": self.samples.flight[first.row].astype(np.int32)}
        for kind, axes in self.series.items():
            for recursion in axes.values():
                for j, name in enumerate(recursion.names):
                    columns[f"{kind}_{name}"] = recursion.coefficients[:, j].copy()
                    columns[f"std_{kind}_{name}"] = recursion.errors[:, j].copy()
        return columns


def elapsed(samples: Samples) -> np.ndarray:
    """Time over all flights, one after the other, (k,) (s)."""
    step = np.diff(samples.time, prepend=samples.time[0])
    usual = float(np.median(step[1:]))
    step[np.r_[True, samples.segment[1:] != samples.segment[:-1]]] = usual
    return np.cumsum(step) - usual
