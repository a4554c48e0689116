"""Acceleration of the air on the vehicle as a sum of named terms, axis by axis: every model beyond the thrust curve.

    a_i = sum_j c_ij phi_ij(v, a_rotor)                body FLU, m/s^2

of the air-relative body velocity v (m/s) and of the acceleration that each rotor's thrust gives (m/s^2). The terms phi
are defined in quadexp.air.terms. LINEAR and QUADRATIC are the drag models (blade element: quadexp.learn.lumped):

    linear       a_i = -d_i v_i + b_i                            Faessler et al. 2018
    quadratic    a_i = -d_i v_i - e_i v_i |v_i| + b_i

The intercepts b_x, b_y take up the accelerometer's bias and constant lateral forces (off-axis centre of mass, unequal
rotors); without them bias times mean velocity biases d. Along z the thrust takes up a constant: d_z is fitted together
with the thrust curve (quadexp.learn.thrust_curve), and the quadratic pair together with a correction of the curve's
scale, the term `thrust`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.learn.regression import Regression, half_width
from quadexp.learn.rows import evaluate_rows

AXES = "xyz"
LINEAR = (("linear", "offset"), ("linear", "offset"), ("linear",))
QUADRATIC = (("linear", "quadratic", "offset"), ("linear", "quadratic", "offset"), ("thrust", "linear", "quadratic"))
_ROOT = "1/sqrt(m)"  # (m/s^2) / (m/s sqrt(m/s^2))
UNITS = {
    "linear": "1/s", "offset": "m/s^2", "quadratic": "1/m", "body": "1/m", "hub": _ROOT, "hub_climb": "1/m",
    "thrust": "1", "climb": _ROOT, "advance": "1/m", "induced": _ROOT,
    "inflow": _ROOT, "hub_inflow": "1/m", "hub_square": "m^-3/2",
}  # fmt: skip


def term_columns(
    names: tuple[str, ...],
    axis: int,
    velocity: np.ndarray,
    rotor_acceleration: np.ndarray,
    momentum: float | tuple[float, ...] = 0.0,
) -> np.ndarray:
    """The phi of one axis at k samples, (k, len(names)); velocity (k, 3), rotor_acceleration (k, n)."""
    terms = tuple(tuple(names) if i == axis else () for i in range(3))
    return all_columns(terms, velocity, rotor_acceleration, momentum)[axis]


def all_columns(
    terms: tuple[tuple[str, ...], ...],
    velocity: np.ndarray,
    rotor_acceleration: np.ndarray,
    momentum: float | tuple[float, ...] = 0.0,
) -> list[np.ndarray]:
    """The phi of all axes at k samples; the induced velocity is then solved once for all. terms: names per axis."""
    from quadexp.air.terms import columns_function  # imports CasADi, which loading a model does without

    counts = [len(names) for names in terms]
    columns = np.empty((len(velocity), sum(counts)))
    if columns.size:
        function = columns_function(tuple(map(tuple, terms)), rotor_acceleration.shape[1], momentum)
        evaluate_rows(function, (velocity, rotor_acceleration), columns)
    ends = np.cumsum(counts)
    return [columns[:, end - count : end] for end, count in zip(ends, counts, strict=True)]


@dataclass(frozen=True)
class TermModel:
    """Coefficients of one model.

    kind: "linear", "quadratic" or "blade_element". terms: names per axis. coefficients: per axis (p_i,). covariance:
    per axis (p_i, p_i). freedom: per axis, degrees of freedom of Student's t. residual_std: (3,), root mean square of
    the fit's residuals, m/s^2. condition: (3,), condition numbers. rotors: n. momentum: kappa (1/m), or the four
    numbers of quadexp.air.terms.Inflow. loss: "squares" or "huber".
    """

    kind: str
    terms: tuple[tuple[str, ...], ...]
    coefficients: tuple[np.ndarray, ...]
    covariance: tuple[np.ndarray, ...]
    freedom: tuple[int, ...]
    residual_std: np.ndarray
    condition: np.ndarray
    rotors: int
    momentum: float | tuple[float, ...] = 0.0
    loss: str = "squares"

    def acceleration(self, velocity: np.ndarray, rotor_acceleration: np.ndarray) -> np.ndarray:
        """Acceleration beyond the thrust curve, (k, 3) body FLU (m/s^2).

        velocity: air-relative, (k, 3) body FLU (m/s). rotor_acceleration: (k, n) (m/s^2), of the thrust curve (or rotor
        thrusts over mass). Raises DataError for another number of rotors than the model's.
        """
        if rotor_acceleration.shape[1] != self.rotors:
            raise DataError(f"{rotor_acceleration.shape[1]} rotors, the model has {self.rotors}")
        columns = all_columns(self.terms, velocity, rotor_acceleration, self.momentum)
        return np.stack([design @ c for design, c in zip(columns, self.coefficients, strict=True)], axis=1)

    def coefficient(self, axis: str, term: str) -> tuple[float, float]:
        """Value and standard error of one coefficient, (0, 0) where the model has no such term."""
        i = AXES.index(axis)
        if term not in self.terms[i]:
            return 0.0, 0.0
        j = self.terms[i].index(term)
        return float(self.coefficients[i][j]), float(np.sqrt(self.covariance[i][j, j]))

    def records(self) -> list[dict[str, Any]]:
        """One record per coefficient: axis, term, value, error, low, high (95 %), unit."""
        records = []
        for i, axis in enumerate(AXES):
            for name in self.terms[i]:
                value, error = self.coefficient(axis, name)
                half = float(half_width(error, self.freedom[i]))
                records.append(
                    {"axis": axis, "term": name, "value": value, "error": error}
                    | {"low": value - half, "high": value + half, "unit": UNITS[name]}
                )
        return records


def term_model(
    kind: str,
    terms: tuple[tuple[str, ...], ...],
    fits: list[Regression],
    rotors: int,
    momentum: float | tuple[float, ...],
    loss: str,
) -> TermModel:
    """The model from one regression per axis, whose last columns are the terms."""
    own = [slice(len(fit.coefficients) - len(names), None) for fit, names in zip(fits, terms, strict=True)]
    return TermModel(
        kind, terms, tuple(fit.coefficients[k] for fit, k in zip(fits, own, strict=True)),
        tuple(fit.covariance[k, k] for fit, k in zip(fits, own, strict=True)),
        tuple(fit.freedom for fit in fits), np.array([np.sqrt(np.mean(fit.residual**2)) for fit in fits]),
        np.array([fit.condition for fit in fits]), rotors, momentum, loss,
    )  # fmt: skip
