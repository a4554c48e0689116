"""Acceleration of the air on the vehicle as a sum of named terms, axis by axis: every model beyond the thrust curve.

    a_i = sum_j c_ij phi_ij(v, a_rotor)                body FLU, m/s^2

of the air-relative body velocity v (m/s) and of the acceleration that each rotor's thrust gives (m/s^2). The terms phi
are defined in quadexp.air.terms. LINEAR and QUADRATIC are the drag models (blade element: quadexp.models.lumped):

    linear       a_i = -d_i v_i + b_i                            Faessler et al. 2018
    quadratic    a_i = -d_i v_i - e_i v_i |v_i| + b_i

The intercepts b_x, b_y take up the accelerometer's bias and constant lateral forces (off-axis centre of mass, unequal
rotors); without them bias times mean velocity biases d. Along z the thrust takes up a constant: d_z is fitted together
with the thrust curve (quadexp.models.thrust_curve), and the quadratic pair together with a correction of the curve's
scale, the term `thrust`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np

from quadexp.errors import DataError
from quadexp.models.base import Positive, Record, Rotors, Three
from quadexp.models.dataset import ResidualDataset, evaluate_rows
from quadexp.models.regression import Regression, half_width, regress

if TYPE_CHECKING:
    from quadexp.air.terms import TermStructure

AXES = "xyz"
MEANS = ("quadratic", "blade_element")  # kinds that are mean functions
VELOCITY = ("v_x", "v_y", "v_z")
HUB = ("hub", "hub_climb", "body", "offset")
HUB_INFLOW = ("hub", "hub_inflow", "hub_square", "body", "offset")
Z_TERMS = ("thrust", "inflow", "advance", "body")
LINEAR = (("linear", "offset"), ("linear", "offset"), ("linear",))
QUADRATIC = (("linear", "quadratic", "offset"), ("linear", "quadratic", "offset"), ("thrust", "linear", "quadratic"))
WITHOUT_RADIUS = (HUB, HUB, ("thrust", "climb", "advance", "body"))  # see quadexp.models.lumped
SELF_CONSISTENT = (HUB_INFLOW, HUB_INFLOW, Z_TERMS)
_ROOT = "1/sqrt(m)"  # (m/s^2) / (m/s sqrt(m/s^2))
UNITS = {
    "linear": "1/s", "offset": "m/s^2", "quadratic": "1/m", "body": "1/m", "hub": _ROOT, "hub_climb": "1/m",
    "thrust": "1", "climb": _ROOT, "advance": "1/m", "induced": _ROOT,
    "inflow": _ROOT, "hub_inflow": "1/m", "hub_square": "m^-3/2",
}  # fmt: skip


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


Axes = msgspec.Meta(min_length=3, max_length=3)


class TermModel(Record, frozen=True):
    """Coefficients of one model, per axis.

    kind: "linear", "quadratic" or "blade_element". terms: names. coefficients: (p_i,). covariance: (p_i, p_i). freedom:
    degrees of freedom of Student's t. residual_std: root mean square of the fit's residuals, m/s^2. condition:
    condition numbers. momentum: kappa (1/m), or the four numbers of quadexp.air.terms.Inflow. loss: "squares" or
    "huber".
    """

    kind: str
    terms: Annotated[tuple[tuple[str, ...], ...], Axes]
    coefficients: Annotated[tuple[np.ndarray, ...], Axes]
    covariance: Annotated[tuple[np.ndarray, ...], Axes]
    freedom: Annotated[tuple[int, ...], Axes]
    residual_std: Three
    condition: Three
    rotors: Rotors
    momentum: float | tuple[float, ...] = 0.0
    loss: str = "squares"

    def __post_init__(self) -> None:
        super().__post_init__()
        for names, value, covariance in zip(self.terms, self.coefficients, self.covariance, strict=True):
            unknown = [name for name in names if name not in UNITS]
            if unknown:
                raise ValueError(f"terms holds {', '.join(unknown)}; allowed are {', '.join(UNITS)}")
            p = len(names)
            if value.shape != (p,) or covariance.size != p * p:
                raise ValueError(f"coefficients and covariance are not those of the terms {', '.join(names)}")

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


def fit_terms(
    kind: str,
    terms: tuple[tuple[str, ...], ...],
    velocity: np.ndarray,
    rotors: np.ndarray,
    target: np.ndarray,
    stretch: np.ndarray,
    flight: np.ndarray,
    *,
    what: str,
    momentum: float | tuple[float, ...] = 0.0,
    z: Regression | tuple[np.ndarray, np.ndarray] | None = None,
    **options: Any,
) -> TermModel:
    """The model that leaves least of target, (k, 3) (m/s^2), axis by axis; options: of `regress`.

    velocity, rotors: see TermModel.acceleration. z: in place of the columns along z, their derivative and the target,
    or a regression whose last columns they are.
    Raises DataError where the rows do not determine the coefficients.
    """
    columns = all_columns(terms if z is None else (*terms[:2], ()), velocity, rotors, momentum)
    fits: list[Regression] = []
    for i, names in enumerate(terms):
        design, y = columns[i], target[:, i]
        if i == 2 and z is not None:
            if isinstance(z, Regression):
                fits.append(z)
                continue
            design, y = z
        along = [f"{name}_{AXES[i]}" for name in names]
        fits.append(regress(design, y, along, stretch, flight, what=f"{what} along {AXES[i]}", **options))
    own = [slice(len(fit.coefficients) - len(names), None) for fit, names in zip(fits, terms, strict=True)]
    return TermModel(
        kind, tuple(map(tuple, terms)), tuple(fit.coefficients[k] for fit, k in zip(fits, own, strict=True)),
        tuple(fit.covariance[k, k] for fit, k in zip(fits, own, strict=True)),
        tuple(int(fit.freedom) for fit in fits), np.array([np.sqrt(np.mean(fit.residual**2)) for fit in fits]),
        np.array([fit.condition for fit in fits]), rotors.shape[1], momentum, options.get("loss", "squares"),
    )  # fmt: skip


class TermMean(Record, frozen=True, tag_field="kind", tag="terms"):
    """Terms as the mean function of a Gaussian process, to which it returns far from the data.

    mass: kg, to convert rotor thrusts to accelerations. The term `thrust` corrects the thrust curve's scale on z.
    """

    model: TermModel
    mass: Positive

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
    """Least squares of the residual acceleration on the terms of `kind` (a name in MEANS).

    Raises DataError where the data set lacks the vehicle's mass, or does not determine the coefficients.
    """
    mass = (dataset.metadata.get("vehicle") or {}).get("mass")
    if not mass:
        raise DataError(f"gp.mean={kind}: the data set does not contain the vehicle's mass; collect it again")
    terms = QUADRATIC if kind == "quadratic" else WITHOUT_RADIUS
    flight = np.asarray(dataset.columns["flight"])
    model = fit_terms(
        kind, terms, dataset.matrix(VELOCITY), rotor_thrusts(dataset) / mass, dataset.matrix(["a_x", "a_y", "a_z"]),
        flight, flight, what=f"gp.mean={kind}",
    )  # fmt: skip
    return TermMean(model, float(mass))
