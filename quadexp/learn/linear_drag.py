"""Linear rotor drag fitted to residuals (RDRv: Faessler et al. 2018; Torrente et al. 2021, sec. IV).

    a_x = -d_x v_x + b_x        a_y = -d_y v_y + b_y        a_z = -d_z v_z + b_z + kappa T

v the body velocity (m/s), T the collective thrust (N). The published fit has b = 0 and kappa = 0; on z, the drag then
absorbs the motors' loss, which is proportional to the thrust.

loss="huber" (default) is Huber's loss (huber.py): where the true drag is not linear, it reduces the influence of the
few fastest rows, and the controller that uses the fit tracks better. loss="squares" is the published fit.

Intervals treat flights as independent (quadexp.learn.flight_jackknife): 95 % intervals for the fit to many flights of
the same kind, also where the true drag is not linear. Rows of a flight are not independent: intervals that take them so
are 7 to 10 times too small on flights.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.learn.dataset import THRUST, ResidualDataset
from quadexp.learn.flight_jackknife import flight_errors
from quadexp.learn.huber import LOSSES, solve
from quadexp.learn.support import feature_ranges

AXES = "xyz"
LABELS = {
    "flight": "95 % interval over {flights} flights",
    "hc1": "95 % interval as if rows were independent, too narrow for flights",  # of earlier versions
    "blocks": "95 % interval of quadexp identify",
}


@dataclass(frozen=True)
class LinearDrag:
    """a_body = -drag v_body + intercept + (0, 0, thrust_gain T), with one standard error per number.

    drag: (3,) 1/s. intercept: (3,) m/s^2. thrust_gain: 1/kg. *_error: standard errors, same shapes.
    residual_std: (3,), root mean square residual, m/s^2. r_squared: (3,), share of the variance explained.
    n: number of rows. errors: kind of the standard errors. loss: of the fit. vehicle: {name, fingerprint}. dataset:
    record of the data. freedom: (7,), degrees of freedom of Student's t in the order of `parameters`; 0 where there is
    no interval. flights: number of flights. feature_range: of the rows, see quadexp.learn.support.
    """

    drag: np.ndarray
    intercept: np.ndarray
    thrust_gain: float
    drag_error: np.ndarray
    intercept_error: np.ndarray
    thrust_gain_error: float
    residual_std: np.ndarray
    r_squared: np.ndarray
    n: int
    errors: str = "flight"
    loss: str = "huber"
    vehicle: dict[str, Any] = field(default_factory=dict)
    dataset: dict[str, Any] = field(default_factory=dict)
    freedom: np.ndarray = field(default_factory=lambda: np.zeros(7))
    flights: int = 0
    feature_range: dict[str, list[float]] = field(default_factory=dict)

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

    @property
    def half_width(self) -> np.ndarray:
        """Half the 95 % interval of each of `parameters`, (7,); NaN where there is no interval."""
        from scipy.stats import t as student_t

        error = np.concatenate([self.drag_error, self.intercept_error, [self.thrust_gain_error]])
        defined = self.freedom > 0
        return np.where(defined, student_t.ppf(0.975, np.where(defined, self.freedom, 1.0)) * error, np.nan)

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
        target = dataset.matrix([f"a_{axis}"])[:, 0]
        fit, residual = _regression(design, target, flight, f"a_{axis} on {', '.join(names)}", loss, intervals)
        drag[:, i] = fit[:, 0]
        if intercept:
            offset[:, i] = fit[:, -1]
        if len(names) == 2:
            gain[:] = fit[:, 1]
        std[i] = np.sqrt(np.mean(residual**2))
        spread = np.sum((target - target.mean()) ** 2) if intercept else np.sum(target**2)
        r_squared[i] = 1 - np.sum(residual**2) / spread if spread > 0 else 0.0
    return LinearDrag(
        drag[0], offset[0], float(gain[0]), drag[1], offset[1], float(gain[1]), std, r_squared, n, "flight", loss,
        dict(dataset.metadata.get("vehicle") or {}), dataset.summary(),
        np.concatenate([drag[2], offset[2], [gain[2]]]), len(np.unique(flight)),
        feature_ranges(dataset, [THRUST] if thrust else []),
    )  # fmt: skip


def _regression(
    design: np.ndarray, target: np.ndarray, flight: np.ndarray, what: str, loss: str, intervals: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients, standard errors, degrees of freedom, (3, p), and residuals (n,)."""
    n, p = design.shape
    if n < p + 2:
        raise DataError(f"drag fit of {what}: {n} rows for {p} coefficients, at least {p + 2} are needed")
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0] = 1.0
    x = design / scale
    if np.abs(np.diag(np.linalg.qr(x, mode="r"))).min() < 1e-8:
        raise DataError(
            f"drag fit of {what}: these columns are not linearly independent over the {n} rows, so the coefficients are"
            " not determined: add flights with more motion, or omit the intercept or the thrust term"
        )
    coefficients, _ = solve(x, target, loss)
    residual = target - x @ coefficients
    error, freedom = np.zeros(p), np.zeros(p)
    if intervals:
        error, freedom = flight_errors(x, target, flight, coefficients, loss)
    return np.stack([coefficients / scale, error / scale, freedom]), residual
