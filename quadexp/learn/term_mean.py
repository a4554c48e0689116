"""Quadratic drag or lumped blade element as the mean function of a Gaussian process.

    m_i = sum_j c_ij phi_ij(v, u / mass)          m/s^2, least squares on the rows that the GP is fitted to

Far from the data the GP returns to this mean instead of zero. Terms: quadexp.air.terms. The term `thrust` corrects the
thrust curve's scale on z.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from quadexp.errors import DataError
from quadexp.learn.dataset import ResidualDataset
from quadexp.learn.regression import regress
from quadexp.learn.terms import AXES, QUADRATIC, TermModel, all_columns, term_model

if TYPE_CHECKING:
    from quadexp.air.terms import TermStructure

KINDS = ("quadratic", "blade_element")
VELOCITY = ("v_x", "v_y", "v_z")


@dataclass(frozen=True)
class TermMean:
    """model: the terms with their coefficients. mass: kg, to convert rotor thrusts to accelerations."""

    model: TermModel
    mass: float

    @property
    def structure(self) -> TermStructure:
        from quadexp.air.terms import TermStructure  # imports CasADi, which loading a model does without

        return TermStructure(self.model.terms, self.mass, self.model.momentum)

    @property
    def parameters(self) -> np.ndarray:
        """The coefficients of all axes, one after the other."""
        return np.concatenate(self.model.coefficients)

    def acceleration(self, dataset: ResidualDataset) -> np.ndarray:
        """Mean function at the rows of a dataset, (k, 3) (m/s^2)."""
        return self.model.acceleration(dataset.matrix(VELOCITY), rotor_thrusts(dataset) / self.mass)


def rotor_thrusts(dataset: ResidualDataset) -> np.ndarray:
    """u_0, u_1, ... of the rows, (k, n) (N)."""
    names = sorted((name for name in dataset.columns if name.startswith("u_")), key=lambda name: int(name[2:]))
    return dataset.matrix(names)


def fit_term_mean(dataset: ResidualDataset, kind: str) -> TermMean:
    """Least squares of the residual acceleration on the terms of `kind` (a name in KINDS).

    Raises DataError where the data set lacks the vehicle's mass, or does not determine the coefficients.
    """
    from quadexp.learn.lumped import WITHOUT_RADIUS  # imports CasADi

    mass = (dataset.metadata.get("vehicle") or {}).get("mass")
    if not mass:
        raise DataError(f"gp.mean={kind}: the data set does not contain the vehicle's mass; collect it again")
    terms = QUADRATIC if kind == "quadratic" else WITHOUT_RADIUS
    velocity, rotors = dataset.matrix(VELOCITY), rotor_thrusts(dataset) / mass
    flight = np.asarray(dataset.columns["flight"])
    columns = all_columns(terms, velocity, rotors)
    fits = [
        regress(
            columns[i], dataset.matrix([f"a_{AXES[i]}"])[:, 0],
            [f"{name}_{AXES[i]}" for name in names], flight, flight, what=f"gp.mean={kind} along {AXES[i]}",
        )
        for i, names in enumerate(terms)
    ]  # fmt: skip
    return TermMean(term_model(kind, tuple(terms), fits, rotors.shape[1], 0.0, "squares"), float(mass))
