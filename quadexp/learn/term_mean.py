"""Drag or lumped blade element as the mean function under a Gaussian process: named terms of velocity and thrust.

    m_i = sum_j c_ij phi_ij(v, u / mass)          m/s^2, least squares on the rows that the GP is fitted to

Far from the rows the GP returns to this, not to zero. Terms as in quadexp.learn.body_drag and .lumped; with
"quadratic" and "blade_element" the term `thrust` corrects the thrust curve's scale on z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.air.term_structure import TermStructure
from quadexp.errors import DataError
from quadexp.learn.body_drag import QUADRATIC
from quadexp.learn.dataset import ResidualDataset
from quadexp.learn.regression import regress
from quadexp.learn.terms import AXES, TermModel, term_columns, term_model

KINDS = ("quadratic", "blade_element")
VELOCITY = ("v_x", "v_y", "v_z")


@dataclass(frozen=True)
class TermMean:
    """model: the terms with their coefficients. mass: kg, that turns rotor thrusts into accelerations."""

    model: TermModel
    mass: float

    @property
    def structure(self) -> TermStructure:
        return TermStructure(self.model.terms, self.mass, self.model.momentum)

    @property
    def parameters(self) -> np.ndarray:
        """The coefficients of all axes end to end."""
        return np.concatenate(self.model.coefficients)

    def acceleration(self, dataset: ResidualDataset) -> np.ndarray:
        """Mean function at the rows of a dataset, (k, 3) (m/s^2)."""
        return self.model.acceleration(dataset.matrix(VELOCITY), rotor_thrusts(dataset) / self.mass)


def rotor_thrusts(dataset: ResidualDataset) -> np.ndarray:
    """u_0, u_1, ... of the rows, (k, n) (N)."""
    names = sorted((name for name in dataset.columns if name.startswith("u_")), key=lambda name: int(name[2:]))
    return dataset.matrix(names)


def fit_term_mean(dataset: ResidualDataset, kind: str, momentum: float = 0.0) -> TermMean:
    """Least squares of the residual acceleration on the terms of `kind` (a name in KINDS).

    Raises DataError where the rows do not say the vehicle's mass, or do not tell the terms apart.
    """
    from quadexp.learn.lumped import lumped_terms

    mass = (dataset.metadata.get("vehicle") or {}).get("mass")
    if not mass:
        raise DataError(f"gp.mean={kind}: the data set does not say the vehicle's mass; collect it again")
    terms = QUADRATIC if kind == "quadratic" else lumped_terms(momentum)
    velocity, rotors = dataset.matrix(VELOCITY), rotor_thrusts(dataset) / mass
    flight = np.asarray(dataset.columns["flight"])
    found = [
        regress(
            term_columns(names, i, velocity, rotors, momentum), dataset.matrix([f"a_{AXES[i]}"])[:, 0],
            [f"{name}_{AXES[i]}" for name in names], flight, flight, what=f"gp.mean={kind} along {AXES[i]}",
        )
        for i, names in enumerate(terms)
    ]  # fmt: skip
    return TermMean(term_model(kind, tuple(terms), found, rotors.shape[1], momentum, "squares"), float(mass))
