"""A vehicle identified from its flights: a thrust curve, and models of the acceleration beyond it.

    f = (0, 0, sum_k a_k(signal)) + a_model(v, a_1 .. a_n)           specific force, body FLU, m/s^2

with v the air-relative body velocity. The models for the same curve: linear (drag, always present), quadratic, and
blade_element with lumped coefficients; None where the flights do not determine the coefficients.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from quadexp.errors import UsageError
from quadexp.models.base import Model, Prediction
from quadexp.models.dataset import ResidualDataset
from quadexp.models.linear_drag import LinearDrag
from quadexp.models.terms import TermMean, TermModel
from quadexp.models.thrust_curve import ThrustCurve
from quadexp.models.torque import TorqueModel

if TYPE_CHECKING:
    from quadexp.models.base import Residual
    from quadexp.physics.vehicle import Vehicle

KINDS = ("linear", "quadratic", "blade_element")


class VehicleModel(Model, frozen=True, tag="vehicle_model"):
    """thrust: the curve. linear, quadratic, blade_element: see the module. best: kind with the least held-out error.

    notes: models that could not be fitted, and why. torque: None without a signal per rotor. Of the model's record,
    vehicle: {name, fingerprint, mass}, None where unknown; dataset: also the names of the flights.
    """

    thrust: ThrustCurve
    linear: TermModel
    quadratic: TermModel | None
    blade_element: TermModel | None
    best: str
    notes: tuple[str, ...] = ()
    torque: TorqueModel | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.best not in self.models:
            raise ValueError(f"best is {self.best}; one of {', '.join(self.models)} is needed")

    @property
    def linear_drag(self) -> LinearDrag:
        """Linear drag beyond the thrust curve. The z intercept is in the curve."""
        value, error = np.zeros((2, 3)), np.zeros((2, 3))
        for i, axis in enumerate("xyz"):
            for j, term in enumerate(("linear", "offset")):
                value[j, i], error[j, i] = self.linear.coefficient(axis, term)
        return LinearDrag(
            value[0], value[1], 0.0, error[0], error[1], 0.0, self.linear.residual_std, np.zeros(3),
            int(self.dataset.get("rows", 0)), "blocks", self.linear.loss,
            np.array([*map(float, self.linear.freedom)] * 2 + [0.0]), int(self.dataset.get("flights", 0)),
            vehicle=dict(self.vehicle), dataset=dict(self.dataset),
        )  # fmt: skip

    @property
    def models(self) -> dict[str, TermModel]:
        """The fitted models by kind."""
        return {kind: getattr(self, kind) for kind in KINDS if getattr(self, kind) is not None}

    def model(self, kind: str | None = None) -> TermModel:
        """The model of a kind, None: the best. Raises UsageError where there is none of that kind."""
        kind = kind or self.best
        if kind not in self.models:
            raise UsageError(f"vehicle model: has no '{kind}'; it has {', '.join(self.models)}")
        return self.models[kind]

    def predict(self, rows: ResidualDataset) -> dict[str, Prediction]:
        """Raises UsageError: the thrust of the rows is not that of this model's curve."""
        raise UsageError("an identified vehicle; `quadexp validate` predicts flights with it")

    def residual(self, vehicle: Vehicle, source: str = "", part: str = "best") -> Residual:
        """See Model.residual. part: a kind, or "best"."""
        from quadexp.models.terms import term_residual

        if part == "gaussian_process":
            found = ", ".join(self.models)
            raise UsageError(f"{source}: an identified vehicle, holds no Gaussian process; it has {found}")
        mean = TermMean(self.model(None if part == "best" else part), vehicle.mass)
        return term_residual(vehicle, mean.structure, mean.parameters, source)

    def __str__(self) -> str:
        return f"thrust {self.thrust}; drag {self.linear_drag}"
