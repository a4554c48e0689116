"""Validation of models on flights: one-step residuals and open-loop predictions in one report."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from quadexp.errors import DataError, UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.vehicle_of import refuse_repeated
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.models.checkpoint import edited_note, load_model
from quadexp.names import distinct, without
from quadexp.parts.schema import Config
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.identification import validation
from quadexp.plugins.identification.predictors import NOMINAL, Predictor, nominal, predictors
from quadexp.plugins.identification.recorded import recorded_dataset
from quadexp.plugins.identification.thrust_curve import ThrustCurve
from quadexp.plugins.identification.validation import Track
from quadexp.plugins.identification.vehicle_model import FitSettings, VehicleModel, fit_vehicle_model
from quadexp.plugins.logs.samples import FlightRows, gather_to_fit, read_rows
from quadexp.provenance import provenance, versions
from quadexp.report.pairing import grouped
from quadexp.writer import check_output, write_text

HORIZONS = (0.1, 0.5, 1.0)  # s: about those of a rate loop, of an MPC and of a manoeuvre
REPORT_FILE = "validation.json"


def validate(
    models: Sequence[Path], flights: Sequence[Path], config: Config, *, horizons: Sequence[float] = HORIZONS,
    leave_one_out: bool = False, out: Path | None = None, figures: bool = True, force: bool = False,
    progress: Callable[[float, float], None] = lambda done, total: None,
) -> dict[str, Any]:  # fmt: skip
    """Score the models on the flights; with leave_one_out, each flight by models refitted to all the others.

    Returns the report (rows, bands, rollouts, notes, lines, files), also written to `out` if given.
    Raises UsageError for inconsistent models or flights, before anything is written.
    """
    if not models:
        raise UsageError("validate: no model given")
    if any(not h > 0 for h in horizons):
        raise UsageError(f"--horizons: {', '.join(f'{h:g}' for h in horizons)} must all be positive (s)")
    if out is not None:
        check_output(out, force=force, folder=True)
    vehicle = build_vehicle(config.vehicle)
    refuse_repeated("validate", [Path(path.name) for path in models], "two models are named {path}; rename one folder")
    loaded = [(path.name, load_model(path, vehicle=vehicle, unknown=True)) for path in models]
    loaded.sort(key=lambda item: not isinstance(item[1], VehicleModel))  # those that have the thrust curve first
    flown = {path.stem: read_flight(path, whole=True, placed=False) for path in flights}
    if len(flown) < len(flights):
        raise UsageError("--flights: two of them have the same name")
    if leave_one_out and len(flown) < 2:
        raise UsageError("--leave-one-out: needs at least two flights")
    folds = [[name] for name in flown] if leave_one_out else [list(flown)]
    predicted = []
    notes = []
    for path in models:
        edited = edited_note(path)
        if edited:
            notes.append(f"warning: {edited}")
    for done, tested in enumerate(folds):
        progress(done, len(folds))
        others = without(flown, tested)
        chosen = refitted(loaded, others, vehicle) if leave_one_out else loaded
        used = _predictors(chosen, vehicle)
        curve = used[0].curve
        rows = [read_rows(flown[name], name, curve.signal, curve.delay, curve.lag) for name in tested]
        for predictor in used:
            for of_flight in rows:
                predicted.append((predictor.name, (predictor, of_flight)))
            seen = {Path(path).stem for path in predictor.seen}
            for name in tested:
                if name in seen and not leave_one_out:
                    said = f"warning: {name} is one of the flights that {predictor.name} was fitted to"
                    notes.append(f"{said}, so this is not a test")
    progress(len(folds), len(folds))
    by_predictor = grouped(predicted)
    scored = [validation.residuals(of_one) for of_one in by_predictor.values()]
    report = {
        "models": [str(path) for path in models], "flights": list(flown), "leave_one_out": leave_one_out,
        "nominal": None if leave_one_out else str(used[0].curve),
        "rows": validation.score_rows(scored), "bands": validation.band_rows(scored),
        "rollouts": [row for of_one in by_predictor.values() for row in _rollouts(of_one, horizons, vehicle)],
        "torque": _replayed(flown, vehicle), "notes": distinct(notes),
        "versions": versions(), "provenance": provenance(),
    }  # fmt: skip
    from quadexp.plugins.identification.lines import validation_lines

    lines = validation_lines(report)
    files = {}
    if out is not None:
        files["report"] = str(out / REPORT_FILE)
        write_text(out / REPORT_FILE, json.dumps(report, indent=1, default=str) + "\n", force=force)
        if figures:
            from quadexp.plugins.drawing.style import save
            from quadexp.plugins.identification.figures import validation_figures

            files |= {name: str(save(figure, out / name)) for name, figure in validation_figures(report).items()}
    return {**report, "lines": lines, "files": files}


def _replayed(flown: Mapping[str, Flight], vehicle: Vehicle) -> dict[str, Any]:
    """{"rollouts": of torque.replayed} of these flights, each by those fitted to the others; {"note"} where there is
    none."""
    from quadexp.plugins.identification.torque import beats_blind, replayed, torque_data

    flights = list(flown.values())
    names = list(flown)
    try:
        samples = gather_to_fit(flights, None, names)
        rollouts = replayed(torque_data(flights, names, vehicle, samples, variants=False).turnings)
    except DataError as error:
        return {"note": f"no replay model of the torque: {error}"}
    return {"rollouts": rollouts, "shown": beats_blind(rollouts)}


def _predictors(loaded: Sequence[tuple[str, Any]], vehicle: Vehicle) -> list[Predictor]:
    """All predictors, nominal first, with unique names where several identified vehicles are compared."""
    curve: ThrustCurve | None = None
    all_of_them = []
    several = sum(isinstance(model, VehicleModel) for _, model in loaded) > 1
    for label, model in loaded:
        for predictor in predictors(model, label, vehicle, curve):
            if several and isinstance(model, VehicleModel):
                predictor = replace(predictor, name=f"{label}: {predictor.name}")
            all_of_them.append(predictor)
        curve = curve or getattr(model, "thrust", None)
    if all(predictor.name != NOMINAL for predictor in all_of_them):
        all_of_them.insert(0, nominal(all_of_them[0].curve, all_of_them[0].seen))
    return all_of_them


def refitted(
    loaded: Sequence[tuple[str, Any]], flights: Mapping[str, Flight], vehicle: Vehicle
) -> list[tuple[str, Any]]:
    """Models of the same kinds and settings, fitted to other flights.

    A GP is fitted with the first identified vehicle's thrust curve, or with one fitted here.
    """
    fresh: list[tuple[str, Any]] = []
    curve: ThrustCurve | None = None
    names = list(flights)
    recorded = list(flights.values())
    for label, model in loaded:
        if isinstance(model, VehicleModel):
            known = vehicle if model.vehicle.get("fingerprint") == vehicle.fingerprint else None
            again = fit_vehicle_model(recorded, known, _settings(model, len(flights)), names=names)
            curve = curve or again.thrust
        else:
            if curve is None:
                curve = fit_vehicle_model(recorded, None, names=names).thrust
            again = model.refitted(recorded_dataset(recorded, vehicle, curve, names=names))
        fresh.append((label, again))
    return fresh


def _settings(model: VehicleModel, flights: int) -> FitSettings:
    """Settings that fit the same kind of model: signal, powers and voltage of its thrust curve, kinds of drag.

    A fitted voltage exponent is fitted again to two flights or more; one flight does not determine it.
    """
    curve = model.thrust
    return FitSettings(
        signal=curve.signal, reference_voltage=curve.reference_voltage,
        voltage_exponent=None if curve.voltage_exponent_error and flights > 1 else curve.voltage_exponent,
        powers=tuple(int(p) for p in curve.powers), kinds=tuple(model.models),
        induced=model.blade_element is None or isinstance(model.blade_element.momentum, tuple),
    )  # fmt: skip


def _rollouts(
    predicted: Sequence[tuple[Predictor, FlightRows]], horizons: Sequence[float], vehicle: Vehicle
) -> list[dict[str, Any]]:
    """Open loop with measured attitude; with all 13 states too where the log has a signal per rotor."""
    tracks = [Track(rows, predictor, vehicle.gravity) for predictor, rows in predicted]
    records = validation.rollout_errors(tracks, horizons, tracked=False)
    records += validation.rollout_errors(tracks, horizons, tracked=True)
    curves = [predictor.curve for predictor, _ in predicted]
    if all(curve.signal != "thrust_acceleration" and curve.rotors == vehicle.n_rotors for curve in curves):
        for mode in validation.TURNING:
            records += validation.rollout_errors(tracks, horizons, tracked=True, vehicle=vehicle, mode=mode)
    return records
