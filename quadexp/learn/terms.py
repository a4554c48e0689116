"""Acceleration of air on the vehicle as a sum of named terms, axis by axis: every model beyond the thrust curve.

    a_i = sum_j c_ij phi_ij(v, a_rotor)                body FLU, m/s^2

Each phi is written once, in CasADi (quadexp.air.term_equations), of the air-relative body velocity v (m/s) and of
what every rotor's thrust adds, a_k (m/s^2), so that a model fitted to a log is an expression for a plant or a
controller too. Which phi a model has is said in quadexp.learn.body_drag and quadexp.learn.lumped. With n rotors,
w_k = sqrt(a_k) (sqrt(m/s^2), the rotor speed times sqrt(k_T / m)), V_h^2 = v_x^2 + v_y^2, and V_k the induced velocity
of momentum theory at that thrust:

    linear      -v_i                offset      1
    quadratic   -v_i |v_i|          body        -v_i ||v||
    hub         -v_i sum_k w_k      hub_climb   -v_i n v_z
    thrust      sum_k a_k           climb       -v_z sum_k w_k
    advance     n V_h^2             induced     -sum_k w_k (V_k - V_k,hover)
    hub_inflow  -v_i sum_k y_k      inflow      -sum_k w_k y_k
    hub_square  -v_i sum_k y_k^2 / w_k          y_k = V_k + v_z - V_k,hover
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.learn.regression import Regression, half_width
from quadexp.physics.expression import Expression

AXES = "xyz"
AT_ONCE = 20_000  # rows that one call evaluates
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
    """The phi of an axis for many samples, (k, len(names)); velocity (k, 3), rotor_acceleration (k, n)."""
    terms = tuple(tuple(names) if i == axis else () for i in range(3))
    return all_columns(terms, velocity, rotor_acceleration, momentum)[axis]


def all_columns(
    terms: tuple[tuple[str, ...], ...],
    velocity: np.ndarray,
    rotor_acceleration: np.ndarray,
    momentum: float | tuple[float, ...] = 0.0,
) -> list[np.ndarray]:
    """The same for all axes at once, whose induced velocity then is solved once; terms: names per axis."""
    counts = [len(names) for names in terms]
    columns = np.empty((len(velocity), sum(counts)))
    if sum(counts):
        function = _all_columns_function(tuple(map(tuple, terms)), rotor_acceleration.shape[1], momentum)
        for start in range(0, len(velocity), AT_ONCE):
            at = slice(start, start + AT_ONCE)
            columns[at] = function(velocity[at].T, rotor_acceleration[at].T).full().T
    ends = np.cumsum(counts)
    return [columns[:, end - count : end] for end, count in zip(ends, counts, strict=True)]


@cache
def _all_columns_function(terms: tuple[tuple[str, ...], ...], rotors: int, momentum: float | tuple[float, ...]) -> Any:
    """(v (3,), a (n,)) -> the phi of all axes end to end."""
    import casadi as ca

    from quadexp.air.term_equations import columns_function

    v, a = ca.SX.sym("v", 3), ca.SX.sym("a", rotors)
    found = [columns_function(names, i, rotors, momentum)(v, a) for i, names in enumerate(terms) if names]
    return ca.Function("terms", [v, a], [ca.cse(ca.vertcat(*found))])


@dataclass(frozen=True)
class TermModel:
    """Coefficients of one model. kind: "linear", "quadratic" or "blade_element". terms: three tuples of names.

    coefficients: per axis (p_i,). covariance: per axis (p_i, p_i); freedom: per axis, of Student's t. rotors: n.
    momentum: kappa (1/m), or the four numbers of dynamics.term_equations.Inflow. residual_std: (3,) root mean square
    left in the fit, m/s^2. condition: (3,). loss: of the fit.
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
        thrusts over mass).
        """
        if rotor_acceleration.shape[1] != self.rotors:
            raise DataError(f"{rotor_acceleration.shape[1]} rotors, the model is of {self.rotors}")
        columns = all_columns(self.terms, velocity, rotor_acceleration, self.momentum)
        return np.stack([design @ c for design, c in zip(columns, self.coefficients, strict=True)], axis=1)

    def expression(self, v: Expression, a: Expression) -> Expression:
        """The same in CasADi, (3,), of v (3,) m/s and a (n,) m/s^2."""
        import casadi as ca

        from quadexp.air.term_equations import term_expression

        return ca.vertcat(
            *(
                sum((c * term_expression(name, i, v, a, self.momentum) for name, c in zip(names, row, strict=True)), 0)
                for i, (names, row) in enumerate(zip(self.terms, self.coefficients, strict=True))
            )
        )

    def coefficient(self, axis: str, term: str) -> tuple[float, float]:
        """Value and standard error of one coefficient, (0, 0) where the model has no such term."""
        i = AXES.index(axis)
        if term not in self.terms[i]:
            return 0.0, 0.0
        j = self.terms[i].index(term)
        return float(self.coefficients[i][j]), float(np.sqrt(self.covariance[i][j, j]))

    def rows(self) -> list[dict[str, Any]]:
        """One record a coefficient: axis, term, value, error, low, high (95 %), unit."""
        found = []
        for i, axis in enumerate(AXES):
            for name in self.terms[i]:
                value, error = self.coefficient(axis, name)
                half = float(half_width(error, self.freedom[i]))
                found.append(
                    {"axis": axis, "term": name, "value": value, "error": error}
                    | {"low": value - half, "high": value + half, "unit": UNITS[name]}
                )
        return found


def term_model(
    kind: str,
    terms: tuple[tuple[str, ...], ...],
    found: list[Regression],
    rotors: int,
    momentum: float | tuple[float, ...],
    loss: str,
) -> TermModel:
    """From one regression an axis, whose last columns are the terms."""
    p = [len(names) for names in terms]
    tails = [slice(len(one.coefficients) - k, None) for one, k in zip(found, p, strict=True)]
    return TermModel(
        kind, terms, tuple(one.coefficients[at] for one, at in zip(found, tails, strict=True)),
        tuple(one.covariance[at, at] for one, at in zip(found, tails, strict=True)),
        tuple(one.freedom for one in found), np.array([np.sqrt(np.mean(one.residual**2)) for one in found]),
        np.array([one.condition for one in found]), rotors, momentum, loss,
    )  # fmt: skip
