"""From flights to a vehicle model, and which of its models a flight that was not seen speaks for.

Along z the thrust curve and the drag are one regression. Quadratic and blade-element terms then are fitted to what the
curve leaves, the curve's scale among them (the term `thrust`), so that no drag has to answer for it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.learn.body_drag import LINEAR, QUADRATIC
from quadexp.learn.dataset import ResidualDataset
from quadexp.learn.lumped import SELF_CONSISTENT, lumped_terms, momentum_of
from quadexp.learn.lumped_fit import fit_inflow
from quadexp.learn.regression import Regression, regress
from quadexp.learn.samples import Samples, choose_signal, gather
from quadexp.learn.support import VELOCITY, feature_ranges
from quadexp.learn.terms import AXES, TermModel, all_columns, term_columns, term_model
from quadexp.learn.thrust_curve import ThrustCurve, fit_thrust_samples, thrust_columns
from quadexp.learn.torque import fit_torque
from quadexp.learn.vehicle_model import KINDS, VehicleModel
from quadexp.log.schema import Flight
from quadexp.physics.vehicle import Vehicle

LEVELS = ("nominal", "offset", *KINDS)
LEVEL_NAMES = {
    "nominal": "nominal thrust", "offset": "+ offsets", "linear": "+ linear drag", "quadratic": "+ quadratic drag",
    "blade_element": "blade element, lumped",
}  # fmt: skip
_OFFSET = (("offset",), ("offset",), ())


@dataclass(frozen=True)
class FitSettings:
    """How a vehicle model is fitted.

    signal, reference_voltage, powers, thrust_intercept, per_rotor: of the thrust curve, None for what the flights
    suggest; voltage_exponent: None fits it. radius: of the rotors, m, for the induced velocity. loss: squares or huber.
    kinds: models to fit besides linear. mass: kg, where no vehicle says it. induced: False leaves the induced velocity
    out of the blade element although the radius is known.
    """

    signal: str | None = None
    reference_voltage: float | None = None
    voltage_exponent: float | None = 1.0
    powers: tuple[int, ...] | None = None
    thrust_intercept: bool | None = None
    per_rotor: bool = False
    radius: float | None = None
    mass: float | None = None
    loss: str = "squares"
    kinds: tuple[str, ...] = KINDS
    induced: bool = True

    def __post_init__(self) -> None:
        for kind in self.kinds:
            if kind not in KINDS:
                raise UsageError(f"identify: drag '{kind}' is none of {', '.join(KINDS)}")


class AxisFit(NamedTuple):
    """One regression. axis: "x", "y" or "z". design: (n, p), target: (n,) m/s^2."""

    axis: str
    design: np.ndarray
    target: np.ndarray
    found: Regression


@dataclass(frozen=True)
class LevelFit:
    """A thrust curve, the terms beyond it (or None), and the regressions that they came from."""

    curve: ThrustCurve
    model: TermModel | None
    axes: tuple[AxisFit, ...] = ()

    @property
    def terms(self) -> TermModel:
        """The terms beyond the curve. Raises UsageError for the level that has none."""
        if self.model is None:
            raise UsageError("the nominal thrust curve has no terms beyond it")
        return self.model

    def residual(self, samples: Samples) -> np.ndarray:
        """Specific force that it does not explain, (k, 3) (m/s^2)."""
        rotors = self.curve.of_signal(samples.signal, samples.voltage)
        left = samples.force.copy()
        left[:, 2] -= rotors.sum(axis=1)
        return left if self.model is None else left - self.model.acceleration(samples.velocity, rotors)


def fit_level(
    level: str, samples: Samples, settings: FitSettings, momentum: float = 0.0, *, intervals: bool = True
) -> LevelFit:
    """One rung of the ladder LEVELS; intervals: see `regress`.

    Raises DataError where the samples do not tell its terms apart.
    """
    with_drag = level in KINDS
    curve, joint = fit_thrust_samples(
        samples, reference_voltage=settings.reference_voltage, voltage_exponent=settings.voltage_exponent,
        powers=settings.powers, intercept=settings.thrust_intercept, per_rotor=settings.per_rotor, drag=with_drag,
        loss=settings.loss, intervals=intervals,
    )  # fmt: skip
    if level == "nominal":
        return LevelFit(curve, None)
    rotors = curve.of_signal(samples.signal, samples.voltage)
    target = samples.force - rotors.sum(axis=1)[:, None] * [0, 0, 1]
    terms: tuple[tuple[str, ...], ...] = {"offset": _OFFSET, "linear": LINEAR}.get(level, QUADRATIC)
    ready: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    inflow: float | tuple[float, ...] = 0.0
    if level == "blade_element":
        terms, inflow = lumped_terms(0.0), 0.0
        if momentum:
            found = fit_inflow(samples.velocity, rotors, target[:, 2], momentum, settings.loss)
            terms, inflow, ready["z"] = SELF_CONSISTENT, tuple(found.inflow), (found.design, found.target)
    axes = []
    given = "z" if level in ("offset", "linear") else "".join(ready)
    columns = all_columns(
        tuple(() if AXES[i] in given else names for i, names in enumerate(terms)), samples.velocity, rotors, inflow
    )
    for i, names in enumerate(terms):
        if AXES[i] == "z" and level in ("offset", "linear"):  # the curve's own regression, whose last columns they are
            axes.append(AxisFit("z", thrust_columns(curve, samples, drag=with_drag), samples.force[:, 2], joint))
            continue
        design, aim = ready.get(AXES[i]) or (columns[i], target[:, i])
        one = regress(
            design, aim, [f"{name}_{AXES[i]}" for name in names], samples.segment, samples.flight,
            what=f"{LEVEL_NAMES[level].lstrip('+ ')} along {AXES[i]}", loss=settings.loss,
            intervals=intervals,
        )  # fmt: skip
        axes.append(AxisFit(AXES[i], design, aim, one))
    model = term_model(level, terms, [one.found for one in axes], curve.rotors, inflow, settings.loss)
    return LevelFit(curve, model, tuple(axes))


def fit_vehicle_model(
    flights: Sequence[Flight],
    vehicle: Vehicle | None = None,
    settings: FitSettings | None = None,
    *,
    names: Sequence[str] | None = None,
    samples: Samples | None = None,
    best: str | None = None,
    fitted: Callable[[str, LevelFit], None] = lambda kind, fit: None,
) -> VehicleModel:
    """Thrust curve, linear drag and, where the flights allow, quadratic drag and lumped blade-element coefficients.

    vehicle: for name, mass and rotor radius; None takes the flights' own record of the name. best: which model to
    call the best, by a held-out comparison; None: the last that could be fitted. fitted: is shown every model's kind
    and fit, whose regressors take much memory and are not kept.
    Raises DataError where not even linear drag can be, or where flights are of different vehicles.
    """
    settings = settings or FitSettings()
    samples = samples or gather(flights, choose_signal(flights, settings.signal), names)
    record = vehicle_record(flights, vehicle, settings.mass, samples.names)
    momentum = momentum_of(vehicle, settings.mass, settings.radius)
    linear = fit_level("linear", samples, settings)
    fitted("linear", linear)
    linear = replace(linear, axes=())
    found: dict[str, TermModel | None] = {"quadratic": None, "blade_element": None}
    notes = list(curve_notes(linear.curve))
    for kind in found:
        if kind not in settings.kinds:
            continue
        for kappa in (momentum, 0.0) if kind == "blade_element" and momentum and settings.induced else (0.0,):
            try:
                fit = fit_level(kind, samples, settings, kappa)
                found[kind] = fit.model
                fitted(kind, fit)
                break
            except DataError as error:
                with_it = " with induced velocity" if kappa else ""
                notes.append(f"no {kind} model{with_it}: {error}")
    if found["blade_element"] is not None and not momentum:
        notes.append("blade element without induced velocity: the rotors' radius is unknown (pass --rotor-radius M)")
    kinds = ["linear", *(kind for kind, model in found.items() if model is not None)]
    return VehicleModel(
        linear.curve, linear.terms, found["quadratic"], found["blade_element"],
        best if best is not None and best in kinds else kinds[-1], record, dataset_record(samples),
        {"loss": settings.loss, "signal": samples.kind, "per_rotor": settings.per_rotor, "momentum": momentum},
        tuple(notes), torque=None if vehicle is None else fit_torque(samples, vehicle, linear.curve),
        feature_range=_velocity_ranges(samples.velocity),
    )  # fmt: skip


def _velocity_ranges(velocity: np.ndarray) -> dict[str, list[float]]:
    columns = {name: velocity[:, i] for i, name in enumerate(VELOCITY)}
    return feature_ranges(ResidualDataset(columns, {}))


def curve_beside_quadratic(samples: Samples, settings: FitSettings, curve: ThrustCurve) -> ThrustCurve:
    """The curve with -d v_z - e v_z |v_z| beside it in one regression, where `fit_level` has -d v_z alone.

    Its intervals hold where the drag along z is quadratic; the voltage exponent is the curve's own.
    Raises DataError where the samples do not tell these apart.
    """
    terms = ("linear", "quadratic")
    rotors = curve.of_signal(samples.signal, samples.voltage)
    design = np.hstack([thrust_columns(curve, samples, drag=False), term_columns(terms, 2, samples.velocity, rotors)])
    names = [f"thrust_{j}" for j in range(design.shape[1] - len(terms))] + [f"{name}_z" for name in terms]
    found = regress(
        design, samples.force[:, 2], names, samples.segment, samples.flight,
        what="thrust curve beside quadratic drag", loss=settings.loss,
    )  # fmt: skip
    shape, q = curve.coefficients.shape, curve.coefficients.size
    value, error = found.coefficients, found.errors
    return replace(
        curve, coefficients=value[:q].reshape(shape), errors=error[:q].reshape(shape), freedom=found.freedom,
        intercept=float(value[q]) if curve.has_intercept else 0.0,
        intercept_error=float(error[q]) if curve.has_intercept else 0.0,
    )  # fmt: skip


def curve_notes(curve: ThrustCurve) -> list[str]:
    """What is suspicious in a thrust curve."""
    low, _ = curve.slope_range
    if low < 0:
        where = "" if curve.signal_range is None else f" {curve.signal_range.round(3).tolist()}"
        return [f"the thrust curve falls somewhere between {curve.signal}{where}"]
    return []


def vehicle_record(
    flights: Sequence[Flight], vehicle: Vehicle | None, mass: float | None, names: Sequence[str]
) -> dict[str, Any]:
    """{name, fingerprint, mass}; raises DataError where two flights say they were flown by different vehicles."""
    flown = [dict(flight.metadata.get("vehicle") or {}) for flight in flights]
    known = [(name, one) for name, one in zip(names, flown, strict=True) if one.get("fingerprint")]
    wanted = vehicle.fingerprint if vehicle else known[0][1]["fingerprint"] if known else None
    for name, one in known:
        if one["fingerprint"] != wanted:
            other = vehicle.name if vehicle else known[0][1].get("name")
            raise DataError(f"{name}: flown by vehicle {one.get('name')} ({one['fingerprint']}), not by {other}")
    if vehicle:
        return {"name": vehicle.name, "fingerprint": vehicle.fingerprint, "mass": vehicle.mass}
    first = known[0][1] if known else {}
    return {"name": first.get("name"), "fingerprint": first.get("fingerprint"), "mass": mass}


def dataset_record(samples: Samples) -> dict[str, Any]:
    """What the model remembers of its data."""
    digest = hashlib.sha256()
    for part in (samples.time, samples.force, samples.velocity, samples.signal):
        digest.update(np.ascontiguousarray(part).tobytes())
    step = np.median(np.diff(samples.time))
    return {
        "sha256": digest.hexdigest(), "rows": len(samples), "flights": len(samples.names),
        "duration": float(len(samples) * step), "names": list(samples.names),
    }  # fmt: skip
