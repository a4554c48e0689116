"""A vehicle identified from its flights: a thrust curve, and what the air does beyond it.

    f = (0, 0, sum_k a_k(signal)) + a_model(v, a_1 .. a_n)           specific force, body FLU, m/s^2

with v the air-relative body velocity. The models, each fitted beside the same curve: linear (drag, always there),
quadratic, and blade_element with lumped coefficients; None where the flights could not tell its terms apart.
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
from quadexp.log.schema import Flight

KINDS = ("linear", "quadratic", "blade_element")


@dataclass(frozen=True)
class VehicleModel:
    """thrust: the curve. linear, quadratic, blade_element: see the module; best: the one with the least held-out error.

    vehicle: {name, fingerprint, mass}, as far as known. dataset: {sha256, rows, flights, duration, names}.
    settings: how it was fitted. notes: what could not be fitted, and why. torque: None where the flights do not say
    what every rotor did. feature_range: of body velocity and speed, see quadexp.learn.support.
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
        """Linear drag beyond the thrust curve; every checkpoint has one. The curve has its z intercept."""
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
        """The models that there are, by kind."""
        found = {kind: getattr(self, kind) for kind in KINDS}
        return {kind: model for kind, model in found.items() if model is not None}

    def model(self, kind: str | None = None) -> TermModel:
        """One of the models, the best without a name. Raises UsageError where there is none of that kind."""
        kind = kind or self.best
        if kind not in self.models:
            raise UsageError(f"vehicle model: no '{kind}' in it; it has {', '.join(self.models)}")
        return self.models[kind]

    def rotor_acceleration(self, flight: Flight) -> np.ndarray:
        """Thrust of every rotor per mass, (k, n) (m/s^2)."""
        return self.thrust.rotor_acceleration(flight)

    def specific_force(self, flight: Flight, kind: str | None = None) -> np.ndarray:
        """Predicted specific force, (k, 3) body FLU (m/s^2). kind: a name in KINDS, "nominal", None for the best."""
        rotors = self.thrust.rotor_acceleration(flight)
        force = np.zeros((len(rotors), 3))
        if kind != "nominal":
            force = self.model(kind).acceleration(flight.air_velocity, rotors)
        force[:, 2] += rotors.sum(axis=1)
        return force

    def __str__(self) -> str:
        return f"thrust {self.thrust}; drag {self.drag}"
