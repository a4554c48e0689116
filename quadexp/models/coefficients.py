"""A model of the air as an equation with coefficients that are fitted: what a user writes is one class.

    a_body = f(z, theta)                                                     m/s^2, no torque
    z = [v_body (3, m/s), w (3, rad/s), u (n, N)]

The class is an option of the group `model` (examples/cubic_drag.py): its settings are keys of the fit, `acceleration`
is f, `estimate` finds theta from rows of flights. The rest is made of these: predictions, the residual in an MPC with
its derivatives, the checkpoint. The checkpoint holds the numbers; the equation is that of the class as it is now.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.models.base import AXIS, Model, ModelPart, Prediction, Shape, Three, origin
from quadexp.models.common_scale import with_common_scale
from quadexp.models.dataset import ResidualDataset
from quadexp.models.linear_drag import LinearDrag, baseline
from quadexp.models.residual import Residual, feature_names, symbolic_residual
from quadexp.parts.settings import keyed
from quadexp.physics.expression import NAN, Expression, holds_nan, symbols
from quadexp.physics.vehicle import Vehicle


@keyed
class Equation(ModelPart):
    """Base of a user's model. units: of every coefficient, by name, in the order of theta."""

    units: ClassVar[dict[str, str]] = {}

    def acceleration(self, z: Expression, theta: Expression) -> Expression:
        """f, CasADi: body acceleration, (3,) (m/s^2), of features z (6 + n,) and coefficients theta (p,)."""
        raise NotImplementedError

    def estimate(self, rows: ResidualDataset) -> npt.ArrayLike:
        """theta, (p,), that fits the rows: rows.matrix(["v_x", ..]) and rows.matrix(["a_x", "a_y", "a_z"])."""
        raise NotImplementedError

    def fit(self, rows: ResidualDataset, *, intervals: bool = True, **_: Any) -> Coefficients:
        """See ModelPart. Raises UsageError where the class gives numbers of another shape, or none that are finite."""
        drag = baseline(rows, intervals=intervals)
        rows = with_common_scale(rows).dataset
        theta = np.asarray(self.estimate(rows), float).ravel()
        if len(theta) != len(self.units) or not np.isfinite(theta).all():
            names = ", ".join(self.units) or "none: `units` is empty"
            raise UsageError(f"model={self.kind}: estimate gives {theta}; finite coefficients are needed: {names}")
        used = self.features(_rotors(rows))
        target = rows.matrix(list(AXIS))
        error = np.sqrt(np.mean((target - self.values(rows, theta)) ** 2, axis=0))
        about = origin(rows, used, self, ("numpy", "casadi"))
        return Coefficients(self.kind, tuple(self.units), theta, error, drag, **about)

    def equation(self, n_rotors: int) -> tuple[Expression, Expression, Expression]:
        """z, theta and f as SX. Raises UsageError where f has another shape."""
        z, theta = symbols(ca.SX, z=len(feature_names(n_rotors)), theta=len(self.units))
        value = ca.SX(self.acceleration(z, theta))
        if value.shape != (3, 1):
            raise UsageError(f"model={self.kind}: acceleration gives the shape {value.shape}; (3, 1) is needed")
        if holds_nan(value):
            raise UsageError(f"model={self.kind}: equations of acceleration: {NAN}")
        return z, theta, value

    def features(self, n_rotors: int) -> list[str]:
        """Names of those that f depends on."""
        z, _, value = self.equation(n_rotors)
        depends = ca.which_depends(value, z, 1)
        return [name for name, used in zip(feature_names(n_rotors), depends, strict=True) if used]

    def values(self, rows: ResidualDataset, theta: np.ndarray) -> np.ndarray:
        """f at the rows, (k, 3). Raises DataError where the rows lack a feature."""
        z, parameters, value = self.equation(_rotors(rows))
        names = feature_names(_rotors(rows))
        features = np.zeros((rows.n_rows, len(names)))
        for name in self.features(_rotors(rows)):
            features[:, names.index(name)] = rows.matrix([name])[:, 0]
        function = ca.Function("f", [z, parameters], [value])
        return np.asarray(function(features.T, np.tile(theta[:, None], (1, rows.n_rows))).full()).T


class Coefficients(Model, frozen=True, tag="coefficients"):
    """Fitted coefficients of an Equation.

    model: its kind. names, theta: of the coefficients. residual_std: root mean square error on the rows, m/s^2.
    """

    model: str
    names: tuple[str, ...]
    theta: Annotated[np.ndarray, Shape("names")]
    residual_std: Three
    linear_drag: LinearDrag

    @property
    def kind(self) -> str:
        return self.model

    @property
    def predictor(self) -> str:  # type: ignore[override]  # of other models the same for all
        return self.model

    @property
    def _equation(self) -> Equation:
        """The class as it is now. Raises UsageError where it has other coefficients than were fitted."""
        part: Any = self.part
        if tuple(getattr(part, "units", ())) != self.names:
            named = ", ".join(getattr(part, "units", ())) or "none"
            raise UsageError(
                f"model={self.model}: the checkpoint holds {', '.join(self.names)}, the class has {named}: fit it again"
            )
        return part

    def predict(self, rows: ResidualDataset) -> dict[str, Prediction]:
        values = self._equation.values(rows, self.theta)
        return {output: Prediction(values[:, i], None, self.residual_std[i] ** 2) for output, i in AXIS.items()}

    def residual(self, vehicle: Vehicle, source: str = "", part: str = "best") -> Residual:
        self.require(part, source)
        z, theta, value = self._equation.equation(vehicle.n_rotors)
        outputs = ca.vertcat(value, ca.SX(3, 1))
        return symbolic_residual(self.model, outputs, z, theta, self.theta, source=source)

    @property
    def summary(self) -> str:
        return f"{self.model}: {', '.join(self._terms())},"

    @property
    def numbers(self) -> dict[str, Any]:
        return {"coefficients": dict(zip(self.names, self.theta.tolist(), strict=True))}

    def described(self, report: Callable[[], Mapping[str, Any]]) -> tuple[dict[str, Any], list[str]]:
        """See Model; it needs no class."""
        equation = f"equation    {', '.join(self._terms())}"
        return self.numbers, [equation, *super().described(report)[1]]

    def _terms(self) -> Sequence[str]:
        return [f"{name} = {value:.5g}" for name, value in zip(self.names, self.theta, strict=True)]


def _rotors(rows: ResidualDataset) -> int:
    return sum(name.startswith("u_") for name in rows.columns) or 4  # without thrusts no model can depend on any
