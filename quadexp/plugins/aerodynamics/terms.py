"""Acceleration of the air on the vehicle as a sum of named terms, axis by axis: every model beyond the thrust curve.

    a_i = sum_j c_ij phi_ij(v, a)                body FLU, m/s^2

of the air-relative body velocity v (m/s) and of the acceleration a_k = u_k / m that each rotor's thrust gives (m/s^2),
so that a model fitted to a log serves a plant or a controller too. The coefficients c are runtime parameters; the set
of terms, the mass and the inflow parameters are structure. Each phi is written here once, in CasADi. With n rotors,
w_k = sqrt(a_k) (sqrt(m/s^2): rotor speed times sqrt(k_T / m)), V_h^2 = v_x^2 + v_y^2, and V_k the induced velocity of
momentum theory at that thrust:

    linear      -v_i                offset      1
    quadratic   -v_i |v_i|          body        -v_i ||v||
    hub         -v_i sum_k w_k      hub_climb   -v_i n v_z
    thrust      sum_k a_k           climb       -v_z sum_k w_k
    advance     n V_h^2             induced     -sum_k w_k (V_k - V_k,hover)
    hub_inflow  -v_i sum_k y_k      inflow      -sum_k w_k y_k
    hub_square  -v_i sum_k y_k^2 / w_k          y_k = V_k + v_z - V_k,hover

LINEAR and QUADRATIC are the drag models:

    linear       a_i = -d_i v_i + b_i                            Faessler et al. 2018
    quadratic    a_i = -d_i v_i - e_i v_i |v_i| + b_i

The intercepts b_x, b_y take up the accelerometer's bias and constant lateral forces (off-axis centre of mass, unequal
rotors); without them bias times mean velocity biases d. Along z the thrust takes up a constant: d_z is fitted together
with the thrust curve (quadexp.plugins.identification.thrust_curve), and the quadratic pair together with a correction
of the curve's scale, the term `thrust`.

SELF_CONSISTENT is the blade-element model of rotors whose geometry is unknown. From blade_element.py (Lei & Li 2017,
equations 9, 10, 14, 15), with s = N_b rho c / 2, climb v_z = -V_z, flow through the rotor u_k = V_k + v_z,
and the airframe's drag (6), the specific force is

    f_z     = (s C_la / m) [ r^3 th/3 sum w^2 + A r th n V_h^2 - r^2/2 sum w (V + v_z) ] - rho S C_Dz/(2m) ||v|| v_z
    f_{x,y} = -(v_i/m) [ s r^2 C_d0/2 sum w - s B r th C_la sum u + s C_la/2 sum u^2/w ] - rho S C_Di/(2m) ||v|| v_i

In hover V_k = nu w_k (Remark 4). With y_k = V_k + v_z - nu w_k, the flow through the rotor beyond that in hover,

    f_z     = [k_T,static/m] sum w^2 - [k_3/m] sum w y + [k_2/m] n V_h^2 - [k_4/m] v_z ||v||
    f_{x,y} = -[h_1/m] v_i sum w - [h_2/m] v_i sum y - [h_3/m] v_i sum y^2/w - [k_4/m] v_i ||v||

    k_T,static = s C_la (r^3 th/3 - r^2 nu/2)        k_3 = s C_la r^2/2        k_2 = s C_la A r th
    h_1 = s (r^2 C_d0/2 - B r th C_la nu + C_la nu^2/2)        h_2 = s C_la (nu - B r th)        h_3 = s C_la/2
    k_4 = rho S C_D/2, per axis

which is the blade-element model exactly, with lumped coefficients. Rotor speeds are not needed: w = sqrt(a / k), with a
the thrust curve's acceleration of a rotor and k = k_T,static/m. For a logged rotor speed this is exact, for a command
an approximation. The coefficients of the terms are then (k in 1/m; sqrt(k) converts w from rad/s to sqrt(m/s^2))

    thrust     correction of the curve's scale           hub         h_1 / (m sqrt(k))
    inflow     k_3 / (m sqrt(k))                         hub_inflow  h_2 / m
    advance    k_2 / m                                   hub_square  h_3 sqrt(k) / m
    body       k_4 / m

V_k follows from momentum theory (17) at the rotor's thrust, which takes the rotor's radius; the coefficients along z
then decide V_k too (quadexp.plugins.identification.inflow).

WITHOUT_RADIUS: where the radius is unknown, V_k - V_hover is left out, its mean is absorbed by `climb` and `advance`,
and hub_climb, -v_i n v_z, replaces the two terms in y. The rotors' own velocities (omega x r_k) cancel from the sums to
first order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import DataError, UsageError
from quadexp.models.adapting import TYPICAL_SPEED, Adapting, Block
from quadexp.models.base import Positive, Record, Rotors, Three
from quadexp.models.dataset import ResidualDataset, evaluate_rows
from quadexp.models.regression import Regression, half_width
from quadexp.models.residual import AXES, VELOCITY, Residual, feature_names, symbolic_residual
from quadexp.physics.expression import Expression, symbols
from quadexp.physics.state import root_mean_square
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.blade_element import TINY_SPEED
from quadexp.plugins.aerodynamics.blocks import regress
from quadexp.plugins.aerodynamics.induced_velocity import Balance, safe_newton

Axes = tuple[tuple[str, ...], ...]  # names of the terms, per axis
Momentum = float | tuple[float, ...]  # kappa (1/m), 0 where unknown, or the four numbers of an `Inflow`

LEAST_ACCELERATION = 1e-6  # m/s^2 per rotor: lower bound under the square root, which keeps it differentiable
ITERATIONS = 16  # of the safeguarded Newton method, started at its upper bound
MEANS = ("quadratic", "blade_element")  # kinds that are mean functions
HUB = ("hub", "hub_climb", "body", "offset")
HUB_INFLOW = ("hub", "hub_inflow", "hub_square", "body", "offset")
Z_TERMS = ("thrust", "inflow", "advance", "body")
LINEAR = (("linear", "offset"), ("linear", "offset"), ("linear",))
QUADRATIC = (("linear", "quadratic", "offset"), ("linear", "quadratic", "offset"), ("thrust", "linear", "quadratic"))
WITHOUT_RADIUS = (HUB, HUB, ("thrust", "climb", "advance", "body"))
SELF_CONSISTENT = (HUB_INFLOW, HUB_INFLOW, Z_TERMS)
ADAPTING = (*[("linear", "quadratic", "offset")] * 2, ("linear", "quadratic", "offset", "thrust"))


class Inflow(NamedTuple):
    """Parameters of the induced velocity: kappa V sqrt(V_h^2 + u^2) = a (1 + scale) + advance V_h^2 - loss w y.

    u = V + v_z: flow through the rotor (m/s); y = u - V_hover: its excess over that in hover (m/s), with
    V_hover^2 = a (1 + scale) / kappa. kappa = 2 rho pi r^2 / m (1/m), 0 where unknown. loss (1/sqrt(m)), advance (1/m),
    scale: the z coefficients of the model itself. All three zero: the thrust is taken as the static one.
    """

    kappa: float = 0.0
    loss: float = 0.0
    advance: float = 0.0
    scale: float = 0.0


class OperatingPoint(NamedTuple):
    """v: (3,) m/s. a: (n,) m/s^2. induced: velocity V, (n,) (m/s); None: solved for."""

    v: ca.SX
    a: ca.SX
    inflow: Inflow
    induced: ca.SX | None = None

    @property
    def rotor_speed(self) -> Expression:
        """w = sqrt(a), (n,) (sqrt(m/s^2))."""
        return ca.sqrt(ca.fmax(self.a, LEAST_ACCELERATION))

    @property
    def hover_inflow(self) -> Expression:
        """Induced velocity in hover, (n,) (m/s)."""
        return ca.sqrt(ca.fmax(self.a, LEAST_ACCELERATION) * (1 + self.inflow.scale) / self.inflow.kappa)

    @property
    def balance(self) -> Balance:
        """The equation of V, per mass, as `Inflow` states it."""
        w, (kappa, loss, advance, scale) = self.rotor_speed, self.inflow
        squared = self.v[0] ** 2 + self.v[1] ** 2
        a = ca.fmax(self.a, LEAST_ACCELERATION)
        unloaded = a * (1 + scale) + advance * squared + loss * w * self.hover_inflow
        return Balance(kappa, unloaded, loss * w, squared, -self.v[2])

    @property
    def over_hover(self) -> Expression:
        """V - V_hover, (n,) (m/s)."""
        return (safe_newton(self.balance, ITERATIONS) if self.induced is None else self.induced) - self.hover_inflow

    @property
    def excess(self) -> Expression:
        """y = V + v_z - V_hover, (n,) (m/s)."""
        return self.over_hover + self.v[2]


class Term(NamedTuple):
    """unit: of the coefficient. phi: of an operating point p and the axis i. flow: whether it needs kappa."""

    unit: str
    phi: Callable[[OperatingPoint, int], Expression]
    flow: bool = False


_ROOT = "1/sqrt(m)"  # (m/s^2) / (m/s sqrt(m/s^2))
TERMS = {
    "linear": Term("1/s", lambda p, i: -p.v[i]),
    "offset": Term("m/s^2", lambda p, i: ca.SX(1)),
    "quadratic": Term("1/m", lambda p, i: -p.v[i] * abs(p.v[i])),
    "body": Term("1/m", lambda p, i: -p.v[i] * ca.sqrt(ca.dot(p.v, p.v) + TINY_SPEED**2)),
    "hub": Term(_ROOT, lambda p, i: -p.v[i] * ca.sum1(p.rotor_speed)),
    "hub_climb": Term("1/m", lambda p, i: -p.v[i] * p.a.numel() * p.v[2]),
    "thrust": Term("1", lambda p, i: ca.sum1(p.a)),
    "climb": Term(_ROOT, lambda p, i: -p.v[2] * ca.sum1(p.rotor_speed)),
    "advance": Term("1/m", lambda p, i: p.a.numel() * (p.v[0] ** 2 + p.v[1] ** 2)),
    "induced": Term(_ROOT, lambda p, i: -ca.dot(p.rotor_speed, p.over_hover), flow=True),
    "inflow": Term(_ROOT, lambda p, i: -ca.dot(p.rotor_speed, p.excess), flow=True),
    "hub_inflow": Term("1/m", lambda p, i: -p.v[i] * ca.sum1(p.excess), flow=True),
    "hub_square": Term("m^-3/2", lambda p, i: -p.v[i] * ca.sum1(p.excess**2 / p.rotor_speed), flow=True),
}


def term_expressions(terms: Axes, v: Expression, a: Expression, momentum: Momentum = 0.0) -> list[list[Expression]]:
    """The phi of every axis, scalars; v (3,) m/s, a (n,) m/s^2.

    Raises UsageError for a term with induced velocity where kappa is unknown.
    """
    point = OperatingPoint(v, a, Inflow(*momentum) if isinstance(momentum, tuple | list) else Inflow(momentum))
    for name in (name for names in terms for name in names):
        if TERMS[name].flow and not point.inflow.kappa > 0:
            raise UsageError(f"term '{name}' needs the rotors' radius and the vehicle's mass")
    return [[TERMS[name].phi(point, axis) for name in names] for axis, names in enumerate(terms)]


@cache
def _columns_function(terms: Axes, rotors: int, momentum: Momentum) -> ca.Function:
    """(v (3,), a (n,)) -> the phi of all axes one after the other."""
    v, a = symbols(ca.SX, v=3, a=rotors)
    phi = sum(term_expressions(terms, v, a, momentum), [])
    return ca.Function("terms", [v, a], [ca.densify(ca.cse(ca.vertcat(*phi)))])


def all_columns(
    terms: Axes, velocity: np.ndarray, rotor_acceleration: np.ndarray, momentum: Momentum = 0.0
) -> list[np.ndarray]:
    """The phi of all axes at k samples; the induced velocity is then solved once for all."""
    counts = [len(names) for names in terms]
    columns = np.empty((len(velocity), sum(counts)))
    if columns.size:
        function = _columns_function(tuple(map(tuple, terms)), rotor_acceleration.shape[1], momentum)
        evaluate_rows(function, (velocity, rotor_acceleration), columns)
    return np.split(columns, np.cumsum(counts)[:-1], axis=1)


class TermStructure(NamedTuple):
    """terms: names per axis. mass: kg. momentum: see Momentum."""

    terms: Axes
    mass: float
    momentum: Momentum = 0.0

    @property
    def n_parameters(self) -> int:
        return sum(map(len, self.terms))

    def torque(
        self, vehicle: Vehicle, features: Expression, theta: Expression, gain: Sequence[float | None]
    ) -> Expression:
        """tau_body, (3,) (N m), beyond the vehicle file's. gain: torque over that, of each axis; None: the scale of
        every rotor's thrust, the term `thrust`, is that of its torque too."""
        scale: Expression = ca.SX(1, 1)
        if "thrust" in self.terms[2]:
            before = len(self.terms[0]) + len(self.terms[1])
            scale = theta[before + self.terms[2].index("thrust")]
        beyond = ca.vertcat(*(scale if ratio is None else ratio - 1 for ratio in gain))
        return beyond * (ca.sparsify(ca.DM(vehicle.allocation[1:])) @ features[6:])

    def acceleration(self, features: Expression, theta: Expression) -> Expression:
        """a_body, (3,) (m/s^2), of z = [v_body, w, u] and theta, the coefficients of all axes one after the other."""
        numbers = iter(range(self.n_parameters))
        phi = term_expressions(self.terms, features[:3], features[6:] / self.mass, self.momentum)
        return ca.vertcat(*(sum((theta[next(numbers)] * term for term in axis), ca.SX(0)) for axis in phi))


def term_residual(
    vehicle: Vehicle, structure: TermStructure, coefficients: np.ndarray, source: str = "", *,
    torque: Sequence[float | None] | None = None,
) -> Residual:  # fmt: skip
    """Residual of the terms; coefficients of all axes, (p,). source: for the record. torque: see TermStructure.torque,
    None: as the vehicle file states it."""
    features, theta = symbols(ca.SX, z=len(feature_names(vehicle.n_rotors)), theta=structure.n_parameters)
    beyond = ca.SX(3, 1) if torque is None else structure.torque(vehicle, features, theta, torque)
    outputs = ca.vertcat(structure.acceleration(features, theta), beyond)
    return symbolic_residual("identified", outputs, features, theta, coefficients, source=source)


def adapting_terms(vehicle: Vehicle, deviation: float) -> Adapting:
    """The terms ADAPTING with coefficients that adapt, from zero. deviation: s of quadexp.plugins.remedies.online,
    m/s^2."""
    structure = TermStructure(ADAPTING, vehicle.mass)
    residual = term_residual(vehicle, structure, np.zeros(structure.n_parameters), "adapted in flight")
    hover = np.full((1, vehicle.n_rotors), vehicle.gravity / vehicle.n_rotors)
    phi = all_columns(ADAPTING, np.full((1, 3), TYPICAL_SPEED), hover)
    places = np.split(np.arange(structure.n_parameters), np.cumsum([columns.size for columns in phi])[:-1])
    blocks = [
        Block(axis, at, np.zeros(len(at)), deviation * np.diag(1 / np.abs(columns[0])))
        for axis, (at, columns) in enumerate(zip(places, phi, strict=True))
    ]
    return Adapting(replace(residual, name="terms"), tuple(blocks))


PerAxis = msgspec.Meta(min_length=3, max_length=3)


class TermModel(Record, frozen=True):
    """Coefficients of one model, per axis.

    kind: "linear", "quadratic" or "blade_element". terms: names. coefficients: (p_i,). covariance: (p_i, p_i). freedom:
    degrees of freedom of Student's t. residual_std: root mean square of the fit's residuals, m/s^2. condition:
    condition numbers. momentum: see Momentum. loss: "squares" or "huber".
    """

    kind: str
    terms: Annotated[Axes, PerAxis]
    coefficients: Annotated[tuple[np.ndarray, ...], PerAxis]
    covariance: Annotated[tuple[np.ndarray, ...], PerAxis]
    freedom: Annotated[tuple[int, ...], PerAxis]
    residual_std: Three
    condition: Three
    rotors: Rotors
    momentum: Momentum = 0.0
    loss: str = "squares"

    def __post_init__(self) -> None:
        super().__post_init__()
        for names, value, covariance in zip(self.terms, self.coefficients, self.covariance, strict=True):
            unknown = [name for name in names if name not in TERMS]
            if unknown:
                raise ValueError(f"terms holds {', '.join(unknown)}; allowed are {', '.join(TERMS)}")
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
        return np.column_stack([design @ c for design, c in zip(columns, self.coefficients, strict=True)])

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
        for axis, names, freedom in zip(AXES, self.terms, self.freedom, strict=True):
            for name in names:
                value, error = self.coefficient(axis, name)
                half = float(half_width(error, freedom))
                record = {"axis": axis, "term": name, "value": value, "error": error}
                records.append(record | {"low": value - half, "high": value + half, "unit": TERMS[name].unit})
        return records


def fit_terms(
    kind: str, terms: Axes, velocity: np.ndarray, rotors: np.ndarray, target: np.ndarray, stretch: np.ndarray,
    flight: np.ndarray, *, what: str, momentum: Momentum = 0.0,
    z: Regression | tuple[np.ndarray, np.ndarray] | None = None, **options: Any,
) -> TermModel:  # fmt: skip
    """The model that leaves least of target, (k, 3) (m/s^2), axis by axis; options: of `regress`.

    velocity, rotors: see TermModel.acceleration. z: in place of the columns along z, their derivative and the target,
    or a regression whose last columns they are.
    Raises DataError where the rows do not determine the coefficients.
    """
    designs = all_columns(terms if z is None else (*terms[:2], ()), velocity, rotors, momentum)
    targets = list(target.T)
    if isinstance(z, tuple):
        designs[2], targets[2] = z
    fits: list[Regression] = []
    for axis, names, design, along in zip(AXES, terms, designs, targets, strict=True):
        if axis == "z" and isinstance(z, Regression):
            fits.append(z)
        else:
            named, where = [f"{name}_{axis}" for name in names], f"{what} along {axis}"
            fits.append(regress(design, along, named, stretch, flight, what=where, **options))
    last = [(fit, slice(len(fit.coefficients) - len(names), None)) for fit, names in zip(fits, terms, strict=True)]
    return TermModel(
        kind, tuple(map(tuple, terms)), tuple(fit.coefficients[k] for fit, k in last),
        tuple(fit.covariance[k, k] for fit, k in last), tuple(int(fit.freedom) for fit in fits),
        np.array([root_mean_square(fit.residual) for fit in fits]), np.array([fit.condition for fit in fits]),
        rotors.shape[1], momentum, options.get("loss", "squares"),
    )  # fmt: skip


class TermMean(Record, frozen=True, tag_field="kind", tag="terms"):
    """Terms as the mean function of a Gaussian process, to which it returns far from the data.

    mass: kg, to convert rotor thrusts to accelerations. The term `thrust` corrects the thrust curve's scale on z.
    """

    model: TermModel
    mass: Positive

    @property
    def structure(self) -> TermStructure:
        return TermStructure(self.model.terms, self.mass, self.model.momentum)

    @property
    def parameters(self) -> np.ndarray:
        """The coefficients of all axes, one after the other."""
        return np.concatenate(self.model.coefficients)

    def acceleration(self, dataset: ResidualDataset) -> np.ndarray:
        """Mean function at the rows of a dataset, (k, 3) (m/s^2)."""
        return self.model.acceleration(dataset.matrix(VELOCITY), dataset.rotor_thrusts / self.mass)


def fit_term_mean(dataset: ResidualDataset, kind: str) -> TermMean:
    """Least squares of the residual acceleration on the terms of `kind` (a name in MEANS).

    Raises DataError where the data set lacks the vehicle's mass, or does not determine the coefficients.
    """
    mass = (dataset.metadata.get("vehicle") or {}).get("mass")
    if not mass:
        raise DataError(f"model.mean={kind}: the data set does not contain the vehicle's mass; collect it again")
    terms = QUADRATIC if kind == "quadratic" else WITHOUT_RADIUS
    flight = dataset.columns["flight"]
    model = fit_terms(
        kind, terms, dataset.matrix(VELOCITY), dataset.rotor_thrusts / mass, dataset.matrix(["a_x", "a_y", "a_z"]),
        flight, flight, what=f"model.mean={kind}",
    )  # fmt: skip
    return TermMean(model, float(mass))
