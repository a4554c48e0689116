"""A vehicle identified from its flights: a thrust curve, and models of the acceleration beyond it.

    f = (0, 0, sum_k a_k(signal)) + a_model(v, a_1 .. a_n)           specific force, body FLU, m/s^2

with v the air-relative body velocity. The models for the same curve: linear (drag, always present), quadratic, and
blade_element with lumped coefficients; None where the flights do not determine the coefficients. Along z the thrust
curve and linear drag are one regression. Quadratic and blade-element terms are then fitted to the curve's residual
together with a correction of its scale (the term `thrust`), which would otherwise bias the drag.

comparison.py compares them on flights left out.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.log.runs import period_of
from quadexp.log.schema import Flight
from quadexp.models.base import Model, Prediction, feature_ranges
from quadexp.models.dataset import ResidualDataset
from quadexp.models.linear_drag import LinearDrag
from quadexp.models.residual import AXES, VELOCITY, Residual
from quadexp.names import named
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.terms import (
    LINEAR,
    QUADRATIC,
    SELF_CONSISTENT,
    WITHOUT_RADIUS,
    Axes,
    Momentum,
    TermMean,
    TermModel,
    fit_terms,
    term_residual,
)
from quadexp.plugins.identification.inflow import fit_inflow, momentum_of
from quadexp.plugins.identification.thrust_curve import CurveSettings, ThrustCurve, fit_thrust_samples
from quadexp.plugins.identification.torque_gain import TorqueGain
from quadexp.plugins.logs.samples import Samples, gather_to_fit

KINDS = ("linear", "quadratic", "blade_element")
LEVELS = ("nominal", "offset", *KINDS)
LEVEL_NAMES = {
    "nominal": "nominal thrust", "offset": "+ offsets", "linear": "+ linear drag", "quadratic": "+ quadratic drag",
    "blade_element": "blade element, lumped",
}  # fmt: skip
HOVER_INFLOW = "blade_element_still"  # key of the blade-element model whose induced velocity is that of hover
_OFFSET = (("offset",), ("offset",), ())


class VehicleModel(Model, frozen=True, tag="vehicle_model"):
    """thrust: the curve. linear, quadratic, blade_element: see the module. best: kind with the least held-out error.

    notes: models that could not be fitted, and why. torque: gain of the rotors' torque (torque_gain.py), None where the
    flights do not show it. Of the model's record,
    vehicle: {name, fingerprint, mass}, None where unknown; dataset: also the names of the flights.
    """

    thrust: ThrustCurve
    linear: TermModel
    quadratic: TermModel | None
    blade_element: TermModel | None
    best: str
    notes: tuple[str, ...] = ()
    torque: TorqueGain | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.best not in self.models:
            raise ValueError(f"best is {self.best}; one of {', '.join(self.models)} is needed")

    @property
    def linear_drag(self) -> LinearDrag:
        """Linear drag beyond the thrust curve. The z intercept is in the curve."""
        linear = self.linear
        drag, drag_error = np.transpose([linear.coefficient(axis, "linear") for axis in AXES])
        offset, offset_error = np.transpose([linear.coefficient(axis, "offset") for axis in AXES])
        freedom = np.array([*linear.freedom, *linear.freedom, 0], float)
        return LinearDrag(
            drag, offset, 0.0, drag_error, offset_error, 0.0, linear.residual_std, np.zeros(3),
            int(self.dataset.get("rows", 0)), "blocks", linear.loss, freedom, int(self.dataset.get("flights", 0)),
            vehicle=dict(self.vehicle), dataset=dict(self.dataset), feature_range=dict(self.feature_range),
        )  # fmt: skip

    @property
    def models(self) -> dict[str, TermModel]:
        """The fitted models by kind."""
        return {kind: getattr(self, kind) for kind in KINDS if getattr(self, kind) is not None}

    def model(self, kind: str = "best") -> TermModel:
        """The model of a kind, or the best. Raises UsageError where there is none of that kind."""
        if kind == "best":
            kind = self.best
        if kind not in self.models:
            raise UsageError(f"vehicle model: has no '{kind}'; it has {', '.join(self.models)}")
        return self.models[kind]

    def predict(self, rows: ResidualDataset) -> dict[str, Prediction]:
        """Raises UsageError: the thrust of the rows is not that of this model's curve."""
        raise UsageError("an identified vehicle; `quadexp validate` predicts flights with it")

    def residual(self, vehicle: Vehicle, source: str = "", part: str = "best") -> Residual:
        """See Model.residual. part: a kind, or "best"."""
        mean = TermMean(self.model(part), vehicle.mass)
        gain = [None] * 3 if self.torque is None else self.torque.used
        return term_residual(vehicle, mean.structure, mean.parameters, source, torque=gain)

    def described(self, report: Callable[[], Mapping[str, Any]]) -> tuple[dict[str, Any], list[str]]:
        """See Model.described: coefficients with intervals, and models compared."""
        from quadexp.plugins.identification.lines import model_lines, selection_lines

        models = {kind: fitted.records() for kind, fitted in self.models.items()}
        lines = model_lines(self)
        stored = report()
        if stored.get("selection"):
            lines += selection_lines(stored["selection"], stored.get("best_row", self.best))
        lines += [f"note        {note}" for note in self.notes]
        return {"thrust": str(self.thrust), "best": self.best, "models": models}, lines

    def __str__(self) -> str:
        return f"thrust {self.thrust}; drag {self.linear_drag}"


@dataclass(frozen=True)
class FitSettings(CurveSettings):
    """How a vehicle model is fitted; of the thrust curve, None: chosen from the flights.

    signal: of the rotors. radius: of the rotors, m, for the induced velocity.
    kinds: models to fit besides linear. induced: False omits the induced velocity from the blade-element model even if
    the radius is known.
    """

    signal: str | None = None
    radius: float | None = None
    kinds: tuple[str, ...] = KINDS
    induced: bool = True


@dataclass(frozen=True)
class LevelFit:
    """A thrust curve, and the terms beyond it (or None)."""

    curve: ThrustCurve
    model: TermModel | None

    @property
    def terms(self) -> TermModel:
        """The terms beyond the curve. Raises UsageError for the level that has none."""
        if self.model is None:
            raise UsageError("the nominal thrust curve has no terms beyond it")
        return self.model

    def residual(self, samples: Samples) -> np.ndarray:
        """Measured minus predicted specific force, (k, 3) (m/s^2)."""
        rotors = self.curve.of_signal(samples.signal, samples.voltage)
        error = samples.force.copy()
        error[:, 2] -= rotors.sum(axis=1)
        if self.model is None:
            return error
        return error - self.model.acceleration(samples.velocity, rotors)


def fit_level(
    level: str, samples: Samples, settings: FitSettings, momentum: float = 0.0, *, intervals: bool = True
) -> LevelFit:
    """Fit one of LEVELS; intervals: see `regress`.

    Raises DataError where the samples do not determine its coefficients.
    """
    curve, joint = fit_thrust_samples(samples, settings, drag=level in KINDS, intervals=intervals)
    if level == "nominal":
        return LevelFit(curve, None)
    rotors = curve.of_signal(samples.signal, samples.voltage)
    target = samples.force - rotors.sum(axis=1)[:, None] * [0, 0, 1]
    terms: Axes = {"offset": _OFFSET, "linear": LINEAR}.get(level, QUADRATIC)
    # The curve's own regression has the z terms of offsets and linear drag as its last columns.
    z: Any = joint if level in ("offset", "linear") else None
    inflow: Momentum = 0.0
    if level == "blade_element":
        terms = WITHOUT_RADIUS
        if momentum:
            fit = fit_inflow(samples.velocity, rotors, target[:, 2], momentum)
            terms = SELF_CONSISTENT
            inflow = tuple(fit.inflow)
            z = (fit.design, fit.target)
    model = fit_terms(
        level, terms, samples.velocity, rotors, target, samples.segment, samples.flight,
        what=LEVEL_NAMES[level].lstrip("+ "), momentum=inflow, z=z, intervals=intervals,
    )  # fmt: skip
    return LevelFit(curve, model)


def fit_vehicle_model(
    flights: Sequence[Flight], vehicle: Vehicle | None = None, settings: FitSettings | None = None, *,
    names: Sequence[str] | None = None, samples: Samples | None = None, best: str | None = None,
) -> VehicleModel:  # fmt: skip
    """Thrust curve, linear drag and, where the flights allow, quadratic drag and lumped blade-element coefficients.

    vehicle: for name, mass and rotor radius; None: the name recorded in the flights. best: the model with the least
    held-out error, by an earlier comparison; None: the last that could be fitted.
    Raises DataError where linear drag cannot be fitted, or where flights are of different vehicles.
    """
    settings = settings or FitSettings()
    samples = samples or gather_to_fit(flights, settings.signal, names)
    record = _vehicle_record(flights, vehicle, samples.names)
    momentum = momentum_of(vehicle, settings.radius)
    linear = fit_level("linear", samples, settings)
    optional: dict[str, TermModel | None] = {"quadratic": None, "blade_element": None}
    notes = []
    if linear.curve.slope_range[0] < 0:
        assert linear.curve.signal_range is not None
        where = f"{linear.curve.signal} {linear.curve.signal_range.round(3).tolist()}"
        notes.append(f"the thrust curve decreases somewhere in the range of {where}")
    for kind in optional:
        if kind not in settings.kinds:
            continue
        inflows = [0.0]
        if kind == "blade_element" and momentum and settings.induced:
            inflows = [momentum, 0.0]
        for kappa in inflows:
            try:
                optional[kind] = fit_level(kind, samples, settings, kappa).model
                break
            except DataError as error:
                inflow = " with induced velocity" if kappa else ""
                notes.append(f"no {kind} model{inflow}: {error}")
    if optional["blade_element"] is not None and not momentum:
        notes.append("blade element without induced velocity: the rotors' radius is unknown (pass --rotor-radius M)")
    kinds = ["linear", *(kind for kind, model in optional.items() if model is not None)]
    velocity = ResidualDataset(named(VELOCITY, samples.velocity.T), {})
    return VehicleModel(
        linear.curve, linear.terms, optional["quadratic"], optional["blade_element"],
        best if best is not None and best in kinds else kinds[-1], tuple(notes),
        vehicle=record, dataset=_dataset_record(samples), feature_range=feature_ranges(velocity),
        settings={"loss": linear.curve.loss, "signal": samples.kind, "momentum": momentum},
    )  # fmt: skip


def _vehicle_record(flights: Sequence[Flight], vehicle: Vehicle | None, names: Sequence[str]) -> dict[str, Any]:
    """{name, fingerprint, mass}; raises DataError where the records of two flights name different vehicles."""
    flown = {}
    for name, flight in zip(names, flights, strict=True):
        record = flight.metadata.get("vehicle") or {}
        if record.get("fingerprint"):
            flown[name] = record
    first = next(iter(flown.values()), {})
    wanted = vehicle.record if vehicle else {"name": None, "fingerprint": None} | first | {"mass": None}
    for name, record in flown.items():
        if record["fingerprint"] != wanted["fingerprint"]:
            said = f"flown by vehicle {record.get('name')} ({record['fingerprint']}), not by {wanted['name']}"
            raise DataError(f"{name}: {said}")
    return {key: wanted[key] for key in ("name", "fingerprint", "mass")}


def _dataset_record(samples: Samples) -> dict[str, Any]:
    """Record of the data that a model was fitted to."""
    digest = hashlib.sha256()
    for part in (samples.time, samples.force, samples.velocity, samples.signal):
        digest.update(np.ascontiguousarray(part).tobytes())
    return {
        "sha256": digest.hexdigest(), "rows": len(samples), "flights": len(samples.names),
        "duration": len(samples) * period_of(samples.time), "names": list(samples.names),
    }  # fmt: skip


def flight_by_flight(samples: Samples, settings: FitSettings) -> list[dict[str, Any]]:
    """Linear drag fitted to every flight alone: {flight, rows, coefficients, thrust} or {flight, rows, note}."""
    records = []
    for index, name in enumerate(samples.names):
        alone = replace(samples.rows(samples.flight == index), names=(name,))
        record = {"flight": name, "rows": len(alone)}
        try:
            fit = fit_level("linear", alone, settings)
            records.append(record | {"coefficients": fit.terms.records(), "thrust": str(fit.curve)})
        except DataError as error:
            records.append(record | {"note": str(error)})
    return records
