"""Linear rotor drag fitted to residuals (RDRv: Faessler et al. 2018; Torrente et al. 2021, sec. IV).

    a_x = -d_x v_x + b_x        a_y = -d_y v_y + b_y        a_z = -d_z v_z + b_z + kappa T

v the body velocity (m/s), T the collective thrust (N). The published fit has b = 0 and kappa = 0; on z that makes the
drag answer for the motors' loss, which goes with the thrust.

loss="huber" (default) minimises sum rho(e / s) with Huber's rho, quadratic up to 1.345 robust standard deviations s
(1.4826 median |e|) and linear beyond (Huber 1964): where the true drag is not linear, the few fastest rows then no
longer bend the line for all others, and the controller that uses it tracks better. loss="squares" is the published fit.

Standard errors are heteroscedasticity-robust (HC1, MacKinnon & White 1985): with psi = rho', H = X' diag(psi') X,
H^-1 X' diag(psi^2) X H^-1 n/(n - p), because the scatter grows with speed where the true drag is not linear.
errors="flight" sums the scores X_k psi_k within each flight first (cluster-robust, Liang & Zeger 1986): larger, and the
right ones where rows of one flight err alike.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.identify.dataset import THRUST, ResidualDataset

ERRORS = ("hc1", "flight")
LOSSES = ("huber", "squares")
HUBER = 1.345  # robust standard deviations; 95 % efficient where the scatter is normal
MAD_TO_STD = 1.4826
ROUNDS = 200  # of reweighting, at the most
AXES = "xyz"


@dataclass(frozen=True)
class LinearDrag:
    """a_body = -drag v_body + intercept + (0, 0, thrust_gain T), with one standard error per number.

    drag: (3,) 1/s. intercept: (3,) m/s^2. thrust_gain: 1/kg. *_error: standard errors, same shapes (0: not fitted).
    residual_std: (3,), root mean square of what is left, m/s^2. r_squared: (3,), share of the variance explained.
    n: rows. errors: which standard errors. loss: which fit.
    vehicle, dataset: fingerprint and hash of what it was fitted to.
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
    errors: str = "hc1"
    loss: str = "huber"
    vehicle: dict[str, Any] = field(default_factory=dict)
    dataset: dict[str, Any] = field(default_factory=dict)

    @property
    def parameters(self) -> np.ndarray:
        """[drag (3,), intercept (3,), thrust_gain], (7,), in the order of quadexp/residual/linear_drag.py."""
        return np.concatenate([self.drag, self.intercept, [self.thrust_gain]])

    @property
    def linear_drag(self) -> LinearDrag:
        """Itself: every checkpoint has one, whatever its kind."""
        return self

    def acceleration(self, dataset: ResidualDataset) -> np.ndarray:
        """Predicted residual acceleration, body frame, (k, 3) (m/s^2)."""
        value = self.intercept - self.drag * dataset.matrix(["v_x", "v_y", "v_z"])
        if self.thrust_gain:
            value[:, 2] += self.thrust_gain * dataset.matrix([THRUST])[:, 0]
        return value

    def __str__(self) -> str:
        terms = [f"d_{a} {d:.4f} +- {e:.4f} 1/s" for a, d, e in zip(AXES, self.drag, self.drag_error, strict=True)]
        if self.thrust_gain_error:
            terms.append(f"kappa {self.thrust_gain:.5f} +- {self.thrust_gain_error:.5f} 1/kg")
        return ", ".join(terms)


def constant_mean(value: np.ndarray) -> LinearDrag:
    """A constant acceleration, (3,) (m/s^2), in the form of a drag model without drag."""
    zero = np.zeros(3)
    return LinearDrag(zero, np.asarray(value, float), 0.0, zero, zero, 0.0, zero, zero, 0, "none")


def fit_linear_drag(
    dataset: ResidualDataset,
    *,
    intercept: bool = True,
    thrust: bool = True,
    errors: str = "hc1",
    loss: str = "huber",
) -> LinearDrag:
    """Regression of the residual acceleration on body velocity, axis by axis.

    intercept, thrust: whether b and kappa are fitted (False, False is the published model).
    errors: "hc1" or "flight"; loss: "huber" or "squares"; see the module.

    Raises DataError if there are fewer rows than two more than coefficients, or if they do not tell the coefficients
    apart (a velocity that never changes, say).
    """
    if errors not in ERRORS:
        raise UsageError(f"drag.errors: '{errors}' is none of {', '.join(ERRORS)}")
    if loss not in LOSSES:
        raise UsageError(f"drag.loss: '{loss}' is none of {', '.join(LOSSES)}")
    n = dataset.n_rows
    drag, offset, gain = np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(2)
    std, r_squared = np.zeros(3), np.zeros(3)
    groups = np.unique(dataset.columns["flight"], return_inverse=True)[1] if errors == "flight" else np.arange(n)
    for i, axis in enumerate(AXES):
        names = [f"v_{axis}"] + [THRUST] * (thrust and axis == "z")
        design = dataset.matrix(names) * np.array([-1.0, 1.0])[: len(names)]
        if intercept:
            design = np.column_stack([design, np.ones(n)])
        target = dataset.matrix([f"a_{axis}"])[:, 0]
        coefficients, error, left = _regression(
            design, target, groups, f"a_{axis} on {', '.join(names)}", robust=loss == "huber"
        )
        drag[:, i] = coefficients[0], error[0]
        if intercept:
            offset[:, i] = coefficients[-1], error[-1]
        if len(names) == 2:
            gain[:] = coefficients[1], error[1]
        std[i] = np.sqrt(np.mean(left**2))
        spread = np.sum((target - target.mean()) ** 2) if intercept else np.sum(target**2)
        r_squared[i] = 1 - np.sum(left**2) / spread if spread > 0 else 0.0
    return LinearDrag(
        drag[0], offset[0], float(gain[0]), drag[1], offset[1], float(gain[1]),
        std, r_squared, n, errors, loss, dict(dataset.metadata.get("vehicle") or {}), dataset.summary(),
    )  # fmt: skip


def _regression(
    design: np.ndarray, target: np.ndarray, groups: np.ndarray, what: str, *, robust: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coefficients, sandwich standard errors, and residuals; scores are summed within groups."""
    n, p = design.shape
    if n < p + 2:
        raise DataError(f"drag fit of {what}: {n} rows for {p} coefficients, at least {p + 2} are needed")
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0] = 1.0
    x = design / scale
    if np.abs(np.diag(np.linalg.qr(x, mode="r"))).min() < 1e-8:
        raise DataError(
            f"drag fit of {what}: these columns do not vary independently over the {n} rows, so their coefficients"
            " cannot be told apart: add flights with more motion, or leave out the intercept or the thrust term"
        )
    coefficients = np.linalg.lstsq(x, target, rcond=None)[0]
    limit = np.inf
    for _ in range(ROUNDS if robust else 0):
        left = target - x @ coefficients
        limit = HUBER * MAD_TO_STD * np.median(np.abs(left))
        if not limit > 1e-12 * np.abs(target).max():  # most rows lie on the line already
            limit = np.inf
            break
        root = np.sqrt(np.minimum(1.0, limit / np.maximum(np.abs(left), limit)))
        before, coefficients = coefficients, np.linalg.lstsq(x * root[:, None], target * root, rcond=None)[0]
        if np.abs(coefficients - before).max() <= 1e-12 * np.abs(coefficients).max():
            break
    left = target - x @ coefficients
    inside = np.abs(left) <= limit
    scores = np.zeros((groups.max() + 1, p))
    np.add.at(scores, groups, x * np.clip(left, -limit, limit)[:, None])
    clusters = len(scores)
    correction = n / (n - p) if clusters == n else clusters / max(clusters - 1, 1) * (n - 1) / (n - p)
    half = np.linalg.solve(x[inside].T @ x[inside], scores.T) / scale[:, None]
    return coefficients / scale, np.sqrt(correction * np.sum(half**2, axis=1)), left
