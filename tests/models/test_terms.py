"""Sums of named terms against the same sums in plain numpy, for vehicles of any mass and any choice of terms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from quadexp.errors import UsageError
from quadexp.models.terms import TermStructure, term_residual

AXES = (
    ("linear", "hub", "hub_climb", "hub_inflow", "hub_square"),
    ("offset", "quadratic", "body"),
    ("thrust", "climb", "advance", "induced", "inflow", "linear"),
)
KAPPA = 0.16  # 1/m


def induced_velocity(a: float, v: np.ndarray) -> float:
    """V with kappa V sqrt(v_x^2 + v_y^2 + (V + v_z)^2) = a, in climb or level flight."""
    return brentq(lambda V: KAPPA * V * np.sqrt(v[0] ** 2 + v[1] ** 2 + (V + v[2]) ** 2) - a, 0, 100, xtol=1e-14)


def terms(v: np.ndarray, a: np.ndarray, i: int) -> dict[str, float]:
    """Every phi of the axis i, as the names say: a (n,) thrusts per mass, w ~ sqrt(a) their rotors' speeds."""
    root, V = np.sqrt(a), np.array([induced_velocity(one, v) for one in a])
    more = V - np.sqrt(a / KAPPA)
    through = more + v[2]
    return {
        "offset": 1.0,
        "linear": -v[i],
        "quadratic": -v[i] * abs(v[i]),
        "body": -v[i] * np.linalg.norm(v),
        "hub": -v[i] * root.sum(),
        "hub_climb": -v[i] * v[2] * len(a),
        "hub_inflow": -v[i] * through.sum(),
        "hub_square": -v[i] * (through**2 / root).sum(),
        "thrust": a.sum(),
        "climb": -v[2] * root.sum(),
        "advance": len(a) * (v[0] ** 2 + v[1] ** 2),
        "induced": -(root * more).sum(),
        "inflow": -(root * through).sum(),
    }


@pytest.mark.parametrize("mass", [0.4, 2.7])
def test_is_the_sum_of_its_terms(odd_vehicle, rng, mass):
    structure = TermStructure(AXES, mass, KAPPA)
    coefficients = rng.normal(size=structure.n_parameters)
    assert structure.n_parameters == 14
    residual = term_residual(odd_vehicle, structure, coefficients)
    for _ in range(5):
        v, rate, u = rng.normal(0, 4, 3), rng.normal(size=3), mass * rng.uniform(0.5, 4, 6)
        v[2] = abs(v[2])
        given = iter(coefficients)
        expected = [
            sum(c * terms(v, u / mass, i)[name] for name, c in zip(names, given, strict=False))
            for i, names in enumerate(AXES)
        ]
        assert residual(np.r_[v, rate, u])[0] == pytest.approx([*expected, 0, 0, 0], rel=1e-9, abs=1e-11)


def test_the_induced_velocity_needs_the_radius(odd_vehicle):
    with pytest.raises(UsageError, match="term 'hub_inflow' needs the rotors' radius"):
        term_residual(odd_vehicle, TermStructure(AXES, 1.0), np.zeros(14))
