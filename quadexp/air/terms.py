"""Residual of a sum of named terms identified from flights: drag, linear or quadratic, or lumped blade element.

    a_body,i = sum_j c_ij phi_ij(v, u / m)                  m/s^2, phi: quadexp.air.term_equations

The coefficients are runtime parameters; which terms there are, the mass and the rotors' momentum factor are structure.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from quadexp.air.base import Residual, feature_names, symbolic_residual
from quadexp.air.term_equations import term_expression
from quadexp.air.term_structure import TermStructure
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle


def term_acceleration(features: Expression, theta: Expression, structure: TermStructure) -> Expression:
    """a_body, (3,) (m/s^2), of z = [v_body, w, u] and theta, the coefficients of all axes end to end."""
    v, a = features[:3], features[6:] / structure.mass
    rows, at = [], 0
    for axis, names in enumerate(structure.terms):
        total = ca.SX(0)
        for name in names:
            total += theta[at] * term_expression(name, axis, v, a, structure.momentum)
            at += 1
        rows.append(total)
    return ca.vertcat(*rows)


def term_residual(vehicle: Vehicle, structure: TermStructure, coefficients: np.ndarray, source: str = "") -> Residual:
    """Residual of the terms alone; coefficients (p,), end to end."""
    features = ca.SX.sym("z", len(feature_names(vehicle.n_rotors)))
    theta = ca.SX.sym("theta", structure.n_parameters)
    outputs = ca.vertcat(term_acceleration(features, theta, structure), ca.SX(3, 1))
    return symbolic_residual("identified", outputs, features, theta, coefficients, source=source)
