"""A vehicle identified from its flights: a thrust curve, and models of the acceleration beyond it.

    f = (0, 0, sum_k a_k(signal)) + a_model(v, a_1 .. a_n)           specific force, body FLU, m/s^2

with v the air-relative body velocity. The models for the same curve: linear (drag, always present), quadratic, and
blade_element with lumped coefficients; None where the flights do not determine the coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.learn.linear_drag import LinearDrag
from quadexp.learn.terms import TermModel
from quadexp.learn.thrust_curve import ThrustCurve
from quadexp.learn.torque import TorqueModel

KINDS = ("linear", "quadratic", "blade_element")


@dataclass(frozen=True)
class VehicleModel:
    """thrust: the curve. linear, quadratic, blade_element: see the module. best: kind with the least held-out error.

    vehicle: {name, fingerprint, mass}, None where unknown. dataset: {sha256, rows, flights, duration, names}. settings:
    of the fit. notes: models that could not be fitted, and why. torque: None without a signal per rotor.
    feature_range: of body velocity and speed, see quadexp.learn.support.
    """

    thrust: ThrustCurve
    linear: TermModel
    quadratic: TermModel | None
    blade_element: TermModel | None
    best: str
    vehicle: dict[str, Any] = field(default_factory=dict)
    dataset: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    versions: dict[str, str] = field(default_factory=dict)
    torque: TorqueModel | None = None
    feature_range: dict[str, list[float]] = field(default_factory=dict)

    @property
    def drag(self) -> LinearDrag:
        """Linear drag beyond the thrust curve; every kind of checkpoint has it. The z intercept is in the curve."""
        value, error = np.zeros((2, 3)), np.zeros((2, 3))
        for i, axis in enumerate("xyz"):
            for j, term in enumerate(("linear", "offset")):
                value[j, i], error[j, i] = self.linear.coefficient(axis, term)
        return LinearDrag(
            value[0], value[1], 0.0, error[0], error[1], 0.0, self.linear.residual_std, np.zeros(3),
            int(self.dataset.get("rows", 0)), "blocks", self.linear.loss, dict(self.vehicle), dict(self.dataset),
            np.array([*map(float, self.linear.freedom)] * 2 + [0.0]), int(self.dataset.get("flights", 0)),
        )  # fmt: skip

    linear_drag = drag

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

    def __str__(self) -> str:
        return f"thrust {self.thrust}; drag {self.drag}"
