"""Linear rotor drag fitted to residuals (RDRv: Faessler et al. 2018; Torrente et al. 2021, sec. IV).

    a_x = -d_x v_x + b_x        a_y = -d_y v_y + b_y        a_z = -d_z v_z + b_z + kappa T

v the body velocity (m/s), T the collective thrust (N). The published fit has b = 0 and kappa = 0; on z, the drag then
absorbs the motors' loss, which is proportional to the thrust.

loss="huber" (default) is Huber's loss (regression.py): where the true drag is not linear, it reduces the influence of
the few fastest rows, and the controller that uses the fit tracks better. loss="squares" is the published fit.

Intervals treat flights as independent (quadexp.models.regression): 95 % intervals for the fit to many flights of
the same kind, also where the true drag is not linear. Rows of a flight are not independent: intervals that take them so
are 7 to 10 times too small on flights.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np

from quadexp.errors import UsageError
from quadexp.models.base import AXIS, Model, Prediction, Shape, Three
from quadexp.models.dataset import THRUST, ResidualDataset
from quadexp.models.regression import LOSSES, half_width, regress
from quadexp.models.support import feature_ranges
from quadexp.models.thrust_scale import with_common_scale

if TYPE_CHECKING:
    from quadexp.air.adapting import Adapting
    from quadexp.air.base import Residual
    from quadexp.models.settings import DragConfig
    from quadexp.physics.vehicle import Vehicle

AXES = "xyz"
LABELS = {
    "flight": "95 % interval over {flights} flights",
    "hc1": "95 % interval as if rows were independent, too narrow for flights",  # of earlier versions
    "blocks": "95 % interval of quadexp identify",
}


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
        """[drag (3,), intercept (3,), thrust_gain], (7,), in the order of quadexp/air/linear_drag.py."""
        return np.concatenate([self.drag, self.intercept, [self.thrust_gain]])

    @property
    def linear_drag(self) -> LinearDrag:
        """Itself; every kind of checkpoint has this property."""
        return self

    def acceleration(self, dataset: ResidualDataset) -> np.ndarray:
        """Predicted residual acceleration, body frame, (k, 3) (m/s^2)."""
        value = self.intercept - self.drag * dataset.matrix(["v_x", "v_y", "v_z"])
        if self.thrust_gain:
            value[:, 2] += self.thrust_gain * dataset.matrix([THRUST])[:, 0]
        return value

    def predict(self, rows: ResidualDataset) -> dict[str, Prediction]:
        """See Model.predict."""
        mean = self.acceleration(rows)
        return {output: Prediction(mean[:, i], None, self.residual_std[i] ** 2) for output, i in AXIS.items()}

    def residual(self, vehicle: Vehicle, source: str = "", part: str = "best") -> Residual:
        """See Model.residual."""
        from quadexp.air.linear_drag import linear_drag_residual

        if part not in ("best", "linear"):
            raise UsageError(f"{source}: holds linear drag, not '{part}'")
        return linear_drag_residual(vehicle, self.drag, self.intercept, self.thrust_gain, source=source)

    def adapting(self, vehicle: Vehicle, residual: Residual, deviation: float | None) -> Adapting:
        """See Model.adapting."""
        from quadexp.air.adapting import adapting_drag

        assert deviation is not None
        return adapting_drag(vehicle, residual, deviation)

    @classmethod
    def fit(cls, rows: ResidualDataset, settings: DragConfig, *, intervals: bool = True, **_: Any) -> LinearDrag:
        """See Model.fit."""
        return fit_linear_drag(
            rows, intercept=settings.intercept, thrust=settings.thrust, loss=settings.loss, intervals=intervals
        )

    def refitted(self, rows: ResidualDataset) -> LinearDrag:
        """See Model.refitted; without the thrust, whose scale the flights have in common."""
        return fit_linear_drag(with_common_scale(rows).dataset, thrust=False, loss=self.loss, intervals=False)

    @property
    def summary(self) -> str:
        """See Model.summary."""
        return f"linear drag {self}"

    @property
    def numbers(self) -> dict[str, Any]:
        """See Model.numbers."""
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
        if self.flights:
            return "no interval: without one of its flights the coefficients are not determined"
        return "no interval: fitted by an older version, which treated rows as independent; fit it again"

    def __str__(self) -> str:
        half = self.half_width
        terms = [f"d_{a} {self.drag[i]:.4f}{_ends(self.drag[i], half[i], 4)} 1/s" for i, a in enumerate(AXES)]
        if self.thrust_gain:
            terms.append(f"kappa {self.thrust_gain:.5f}{_ends(self.thrust_gain, half[6], 5)} 1/kg")
        return f"{', '.join(terms)} ({self.label})"


def _ends(value: float, half: float, digits: int) -> str:
    return f" [{value - half:.{digits}f}, {value + half:.{digits}f}]" if np.isfinite(half) else ""


def constant_mean(value: np.ndarray) -> LinearDrag:
    """A constant acceleration, (3,) (m/s^2), as a drag model with zero drag."""
    zero = np.zeros(3)
    return LinearDrag(zero, np.asarray(value, float), 0.0, zero, zero, 0.0, zero, zero, 0, "none")


def fit_linear_drag(
    dataset: ResidualDataset,
    *,
    intercept: bool = True,
    thrust: bool = True,
    loss: str = "huber",
    intervals: bool = True,
) -> LinearDrag:
    """Regression of the residual acceleration on body velocity, axis by axis.

    intercept, thrust: whether b and kappa are fitted (False, False is the published model). loss: "huber" or "squares";
    see the module. intervals: False computes no errors. Raises DataError for fewer than two rows more than
    coefficients, and where the rows do not determine the coefficients (for instance with a constant velocity).
    """
    if loss not in LOSSES:
        raise UsageError(f"drag.loss: '{loss}' is none of {', '.join(LOSSES)}")
    n = dataset.n_rows
    drag, offset, gain = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    std, r_squared = np.zeros(3), np.zeros(3)
    flight = np.asarray(dataset.columns["flight"])
    for i, axis in enumerate(AXES):
        names = [f"v_{axis}"] + [THRUST] * (thrust and axis == "z")
        design = dataset.matrix(names) * np.array([-1.0, 1.0])[: len(names)]
        if intercept:
            design = np.column_stack([design, np.ones(n)])
            names.append("intercept")
        target = dataset.matrix([f"a_{axis}"])[:, 0]
        fit = regress(
            design, target, names, flight, flight, what=f"drag fit of a_{axis}", loss=loss, intervals=intervals,
            over="flights",
        )  # fmt: skip
        found = np.stack([fit.coefficients, fit.errors, fit.freedom])
        drag[:, i] = found[:, 0]
        if intercept:
            offset[:, i] = found[:, -1]
        if THRUST in names:
            gain[:] = found[:, 1]
        std[i] = np.sqrt(np.mean(fit.residual**2))
        spread = np.sum((target - target.mean()) ** 2) if intercept else np.sum(target**2)
        r_squared[i] = 1 - np.sum(fit.residual**2) / spread if spread > 0 else 0.0
    return LinearDrag(
        drag[0], offset[0], float(gain[0]), drag[1], offset[1], float(gain[1]), std, r_squared, n, "flight", loss,
        np.concatenate([drag[2], offset[2], [gain[2]]]), len(np.unique(flight)),
        vehicle=dict(dataset.metadata.get("vehicle") or {}), dataset=dataset.summary(),
        feature_range=feature_ranges(dataset, [THRUST] if thrust else []),
    )  # fmt: skip
