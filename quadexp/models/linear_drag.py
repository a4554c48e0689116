"""Linear rotor drag with an intercept and a thrust term (RDRv: Faessler et al. 2018; Torrente et al. 2021, sec. IV).

    a_body = -D v + b + (0, 0, kappa T)                                m/s^2

v the body velocity (m/s), T the collective thrust (N), D diagonal (1/s), b (m/s^2), kappa (1/kg). The published fit has
b = 0 and kappa = 0; on z, the drag then absorbs the motors' loss, which is proportional to the thrust.

loss="huber" (default) is Huber's loss (regression.py): where the true drag is not linear, it reduces the influence of
the few fastest rows, and the controller that uses the fit tracks better. loss="squares" is the published fit.

Intervals treat flights as independent (quadexp.models.regression): 95 % intervals for the fit to many flights of
the same kind, also where the true drag is not linear. Rows of a flight are not independent: intervals that take them so
are 7 to 10 times too small on flights.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from quadexp.compile.symbolic import ca
from quadexp.models.adapting import TYPICAL_SPEED, Adapting, Block
from quadexp.models.base import AXIS, Model, ModelPart, Prediction, Shape, Three, origin
from quadexp.models.common_scale import has_thrust_scale, with_common_scale
from quadexp.models.dataset import ResidualDataset
from quadexp.models.regression import half_width, regress
from quadexp.models.residual import AXES, THRUST, VELOCITY, Residual, feature_names, symbolic_residual
from quadexp.parts.settings import key, keyed
from quadexp.physics.drag import linear_drag_force
from quadexp.physics.expression import Expression, symbols
from quadexp.physics.rotation import along_z
from quadexp.physics.state import root_mean_square
from quadexp.physics.vehicle import Vehicle

N_PARAMETERS = 7  # drag 3, intercept 3, thrust gain 1
LABELS = {"flight": "95 % interval over {flights} flights", "blocks": "95 % interval over blocks of samples"}


@keyed
class DragConfig(ModelPart):
    """How linear drag is fitted; see quadexp/models/linear_drag.py."""

    judged = False  # it is what others are compared with

    intercept: bool = key(True, "fit a constant acceleration in addition to the drag")
    thrust: bool = key(True, "fit an error of the collective thrust, as a share, on the z axis")
    loss: Literal["huber", "squares"] = key(
        "huber", "Huber's, which the few fastest rows do not bend, or least squares as published"
    )

    def fit(self, rows: ResidualDataset, *, intervals: bool = True, **_: Any) -> LinearDrag:
        """See ModelPart."""
        return fit_linear_drag(rows, intercept=self.intercept, thrust=self.thrust, loss=self.loss, intervals=intervals)


class LinearDrag(Model, frozen=True, tag="linear_drag"):
    """a_body = -drag v_body + intercept + (0, 0, thrust_gain T), with one standard error per number.

    drag: 1/s. intercept: m/s^2. thrust_gain: 1/kg. *_error: standard errors. residual_std: root mean square residual,
    m/s^2. r_squared: share of the variance explained. n: number of rows. errors: kind of the standard errors. loss: of
    the fit. freedom: degrees of freedom of Student's t in the order of `parameters`; 0 where there is no interval.
    flights: number of flights.
    """

    drag: Three
    intercept: Three
    thrust_gain: float
    drag_error: Three
    intercept_error: Three
    thrust_gain_error: float
    residual_std: Three
    r_squared: Three
    n: int
    errors: str = "flight"
    loss: str = "huber"
    freedom: Annotated[np.ndarray, Shape("7")] = msgspec.field(default_factory=lambda: np.zeros(7))
    flights: int = 0
    predictor = "linear_drag"

    @property
    def parameters(self) -> np.ndarray:
        """theta of the residual: [drag (3,), intercept (3,), thrust_gain], (7,)."""
        return np.concatenate([self.drag, self.intercept, [self.thrust_gain]])

    @property
    def linear_drag(self) -> LinearDrag:
        """Itself; every kind of checkpoint has this property."""
        return self

    def acceleration(self, dataset: ResidualDataset) -> np.ndarray:
        value = self.intercept - self.drag * dataset.matrix(VELOCITY)
        if self.thrust_gain:
            value[:, 2] += self.thrust_gain * dataset.matrix([THRUST])[:, 0]
        return value

    def predict(self, rows: ResidualDataset) -> dict[str, Prediction]:
        mean = self.acceleration(rows)
        return {output: Prediction(mean[:, i], None, self.residual_std[i] ** 2) for output, i in AXIS.items()}

    def residual(self, vehicle: Vehicle, source: str = "", part: str = "best") -> Residual:
        self.require(part, source)
        return linear_drag_residual(vehicle, self.drag, self.intercept, self.thrust_gain, source=source)

    def adapting(self, vehicle: Vehicle, residual: Residual, deviation: float) -> Adapting:
        return adapting_drag(vehicle, residual, deviation)

    def refitted(self, rows: ResidualDataset) -> LinearDrag:
        """See Model.refitted."""
        return baseline(rows, loss=self.loss, intervals=False)

    @property
    def summary(self) -> str:
        return f"linear drag {self}"

    @property
    def numbers(self) -> dict[str, Any]:
        half = [None if np.isnan(value) else float(value) for value in self.half_width[:3]]
        drag = {"drag": self.drag.tolist(), "error": self.drag_error.tolist(), "half_width_95": half}
        return {"drag": {**drag, "intervals": self.label}}

    @property
    def half_width(self) -> np.ndarray:
        """Half the 95 % interval of each of `parameters`, (7,); NaN where there is no interval."""
        error = np.concatenate([self.drag_error, self.intercept_error, [self.thrust_gain_error]])
        return np.where(self.freedom > 0, half_width(error, self.freedom), np.nan)

    @property
    def label(self) -> str:
        """Kind of the intervals, or why there are none."""
        if self.freedom.any():
            return LABELS[self.errors].format(flights=self.flights)
        if self.flights == 1:
            return "no interval: one flight does not show how flights differ"
        return "no interval: without one of its flights the coefficients are not determined"

    def __str__(self) -> str:
        def term(name: str, value: float, half: float, digits: int, unit: str) -> str:
            ends = f" [{value - half:.{digits}f}, {value + half:.{digits}f}]" if np.isfinite(half) else ""
            return f"{name} {value:.{digits}f}{ends} {unit}"

        half = self.half_width
        terms = [term(f"d_{axis}", self.drag[i], half[i], 4, "1/s") for i, axis in enumerate(AXES)]
        terms += [term("kappa", self.thrust_gain, half[6], 5, "1/kg")] if self.thrust_gain else []
        return f"{', '.join(terms)} ({self.label})"


def linear_drag_acceleration(features: Expression, theta: Expression) -> Expression:
    """a_body, (3,) (m/s^2), of z = [v_body, w, u] and theta = [D (3,), b (3,), kappa]."""
    thrust = ca.sum1(features[6:])
    return linear_drag_force(features[:3], theta[:3]) + theta[3:6] + along_z(theta[6] * thrust)


def linear_drag_residual(
    vehicle: Vehicle, drag: npt.ArrayLike, intercept: npt.ArrayLike = (0.0, 0.0, 0.0), thrust_gain: float = 0.0,
    source: str = "",
) -> Residual:  # fmt: skip
    """Linear-drag residual; drag (3,) 1/s, intercept (3,) m/s^2, thrust_gain 1/kg."""
    features, theta = symbols(ca.SX, z=len(feature_names(vehicle.n_rotors)), theta=N_PARAMETERS)
    outputs = ca.vertcat(linear_drag_acceleration(features, theta), ca.SX(3, 1))
    values = np.concatenate([np.asarray(drag), np.asarray(intercept), [thrust_gain]])
    return symbolic_residual("linear_drag", outputs, features, theta, values, source=source)


def adapting_drag(vehicle: Vehicle, residual: Residual, deviation: float) -> Adapting:
    """The residual of linear drag with parameters that adapt. deviation: of the prior, m/s^2."""
    typical = np.array([TYPICAL_SPEED, 1.0, vehicle.mass * vehicle.gravity])
    blocks = []
    for axis, count in enumerate((2, 2, 3)):
        at = np.array([axis, 3 + axis, 6])[:count]
        blocks.append(Block(axis, at, residual.theta[at], deviation * np.diag(1 / typical[:count])))
    return Adapting(residual, tuple(blocks))


def constant_mean(value: np.ndarray) -> LinearDrag:
    """A constant acceleration, (3,) (m/s^2), as a drag model with zero drag."""
    zero = np.zeros(3)
    return LinearDrag(zero, np.asarray(value, float), 0.0, zero, zero, 0.0, zero, zero, 0, "none")


def baseline(rows: ResidualDataset, **options: Any) -> LinearDrag:
    """Linear drag of the rows, with which every model is compared; options: see fit_linear_drag. Under a thrust curve
    without the thrust, whose scale the flights have in common: the term would duplicate the curve's."""
    options = {"thrust": not has_thrust_scale(rows)} | options
    return fit_linear_drag(with_common_scale(rows).dataset, **options)


def fit_linear_drag(
    dataset: ResidualDataset, *, intercept: bool = True, thrust: bool = True, loss: str = "huber",
    intervals: bool = True,
) -> LinearDrag:  # fmt: skip
    """Regression of the residual acceleration on body velocity, axis by axis.

    intercept, thrust: whether b and kappa are fitted (False, False is the published model). loss: "huber" or "squares";
    see the module. intervals: False computes no errors. Raises DataError for fewer than two rows more than
    coefficients, and where the rows do not determine the coefficients (for instance with a constant velocity).
    """
    value, error, freedom = np.zeros((3, N_PARAMETERS))
    std = np.zeros(3)
    r_squared = np.zeros(3)
    flight = dataset.columns["flight"]
    for i, axis in enumerate(AXES):
        names = [f"v_{axis}"] + [THRUST] * (thrust and axis == "z")
        places = [i] + [6] * (len(names) - 1) + [3 + i] * intercept
        design = dataset.matrix(names) * np.array([-1.0, 1.0])[: len(names)]
        if intercept:
            design = np.column_stack([design, np.ones(dataset.n_rows)])
            names.append("intercept")
        target = dataset.matrix([f"a_{axis}"])[:, 0]
        fit = regress(
            design, target, names, flight, what=f"drag fit of a_{axis}", loss=loss, intervals=intervals,
        )  # fmt: skip
        value[places] = fit.coefficients
        error[places] = fit.errors
        freedom[places] = fit.freedom
        std[i] = root_mean_square(fit.residual)
        spread = np.sum((target - target.mean()) ** 2) if intercept else np.sum(target**2)
        r_squared[i] = 1 - np.sum(fit.residual**2) / spread if spread > 0 else 0.0
    return LinearDrag(
        value[:3], value[3:6], float(value[6]), error[:3], error[3:6], float(error[6]), std, r_squared, dataset.n_rows,
        "flight", loss, freedom, len(np.unique(flight)),
        **origin(dataset, [THRUST] if thrust else []),
    )  # fmt: skip
