"""Validation of models on flights: one-step residuals and open-loop predictions in one report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace as with_changes

from quadexp.errors import DataError, UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.models.checkpoint import load_model
from quadexp.models.recorded import recorded_dataset
from quadexp.models.samples import FlightRows, gather, read_rows
from quadexp.models.thrust_curve import ThrustCurve
from quadexp.models.torque import TorqueModel, explained, torque_lines
from quadexp.models.validation import (
    NOMINAL,
    TURNING,
    Predictor,
    Residuals,
    Track,
    band_rows,
    nominal,
    predictors,
    residuals,
    rollout_errors,
    score_rows,
)
from quadexp.models.vehicle_model import FitSettings, VehicleModel, fit_vehicle_model
from quadexp.parts.schema import Config
from quadexp.physics.vehicle import Vehicle
from quadexp.provenance import provenance, versions
from quadexp.writer import check_output, write_text

HORIZONS = (0.1, 0.5, 1.0)
REPORT_FILE = "validation.json"
ProgressCallback = Callable[[float, float], None]


def validate(
    models: Sequence[Path],
    flights: Sequence[Path],
    config: Config,
    *,
    horizons: Sequence[float] = HORIZONS,
    leave_one_out: bool = False,
    out: Path | None = None,
    figures: bool = True,
    force: bool = False,
    progress: ProgressCallback = lambda done, total: None,
) -> dict[str, Any]:
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
    loaded = _load(models, vehicle)
    flown = {path.stem: read_flight(path, whole=True) for path in flights}
    if len(flown) < len(flights):
        raise UsageError("--flights: two of them have the same name")
    if leave_one_out:
        if len(flown) < 2:
            raise UsageError("--leave-one-out: needs at least two flights")
        folds = [(name, [name], [n for n in flown if n != name]) for name in flown]
    else:
        folds = [("", list(flown), [])]
    by_predictor: dict[str, list[tuple[Predictor, FlightRows]]] = {}
    notes: list[str] = []
    torques: list[str] = []
    for done, (_, tested, fitted) in enumerate(folds):
        progress(done, len(folds))
        chosen = loaded
        if leave_one_out:
            chosen = refitted(loaded, {name: flown[name] for name in fitted}, vehicle)
        used, lines = _torque_tested(_predictors(chosen, vehicle), [flown[name] for name in tested], tested, vehicle)
        torques += [f"{', '.join(tested)}: {line}" if leave_one_out else line for line in lines]
        rows = [read_rows(flown[name], name, used[0].curve.signal, used[0].curve.delay) for name in tested]
        if not leave_one_out:
            notes += _seen(used, tested)
        for predictor in used:
            by_predictor.setdefault(predictor.name, []).extend((predictor, one) for one in rows)
    progress(len(folds), len(folds))
    found = [residuals(predicted) for predicted in by_predictor.values()]
    report: dict[str, Any] = {
        "models": [str(path) for path in models],
        "flights": list(flown),
        "leave_one_out": leave_one_out,
        "nominal": None if leave_one_out else str(used[0].curve),
        "rows": score_rows(found, NOMINAL),
        "bands": band_rows(found),
        "rollouts": [row for one in by_predictor.values() for row in _rollouts(one, horizons, vehicle)],
        "torque": torques,
        "notes": list(dict.fromkeys(notes)),
        "versions": versions(),
        "provenance": provenance(),
    }
    from quadexp.report.model_lines import validation_lines

    report["lines"] = validation_lines(report)
    report["files"] = _write(report, found, out, figures, force) if out is not None else {}
    return report


def _load(paths: Sequence[Path], vehicle: Vehicle) -> list[tuple[str, Any]]:
    """Label and checkpoint of every model; identified vehicles first, because they have the thrust curve."""
    loaded = [(path.name, load_model(path, vehicle=vehicle, unknown=True)) for path in paths]
    labels = [label for label, _ in loaded]
    twice = next((label for label in labels if labels.count(label) > 1), None)
    if twice:
        raise UsageError(f"validate: two models are named {twice}; rename the folder of one")
    return sorted(loaded, key=lambda item: not isinstance(item[1], VehicleModel))


def _predictors(loaded: Sequence[tuple[str, Any]], vehicle: Vehicle) -> list[Predictor]:
    """All predictors, nominal first, with unique names where several identified vehicles are compared."""
    curve: ThrustCurve | None = None
    torque: TorqueModel | None = None
    made: list[Predictor] = []
    several = sum(isinstance(model, VehicleModel) for _, model in loaded) > 1
    for label, model in loaded:
        for one in predictors(model, label, vehicle, curve):
            if several and isinstance(model, VehicleModel):
                one = replace(one, name=f"{label}: {one.name}")
            made.append(replace(one, torque=one.torque or torque))
        curve = curve or getattr(model, "thrust", None)
        torque = torque or getattr(model, "torque", None)
    if all(one.name != NOMINAL for one in made):
        made.insert(0, nominal(made[0].curve, made[0].seen))
    return made


def _torque_tested(
    candidates: Sequence[Predictor], flights: Sequence[Flight], names: Sequence[str], vehicle: Vehicle
) -> tuple[list[Predictor], list[str]]:
    """The predictors with the tested torque models, and lines on these.

    An axis is used if its prediction is better than zero both on data held out of the fit and on these flights.
    """
    result: list[Predictor] = []
    lines: list[str] = []
    tested: dict[int, TorqueModel] = {}  # by id of the torque model, which several predictors share
    for one in candidates:
        model = one.torque
        if model is not None and id(model) not in tested:
            samples = gather(flights, one.curve.signal, names).delayed(one.curve.delay)
            share = explained(model, samples, vehicle, one.curve)
            passed = model if share is None else with_changes(model, share_low=np.minimum(model.share_low, share))
            tested[id(model)] = passed
            lines += _torque_lines(model, share)
        result.append(one if model is None else replace(one, torque=tested[id(model)]))
    return result, lines


def _torque_lines(model: TorqueModel, share: np.ndarray | None) -> list[str]:
    lines = []
    for i, line in enumerate(torque_lines(model)):
        here = "" if share is None else f"; {100 * share[i]:.0f} % of it here"
        rejected = model.used[i] and share is not None and share[i] <= 0
        lines.append(line + here + (": not better than zero, rejected" if rejected else ""))
    return lines


def refitted(
    loaded: Sequence[tuple[str, Any]], flights: Mapping[str, Flight], vehicle: Vehicle
) -> list[tuple[str, Any]]:
    """Models of the same kinds and settings, fitted to other flights.

    A GP is fitted with the first identified vehicle's thrust curve, or with one fitted here.
    """
    made: list[tuple[str, Any]] = []
    curve: ThrustCurve | None = None
    for label, model in loaded:
        if isinstance(model, VehicleModel):
            fresh: Any = fit_vehicle_model(
                list(flights.values()),
                vehicle if model.vehicle.get("fingerprint") == vehicle.fingerprint else None,
                _settings(model, len(flights)),
                names=list(flights),
            )
            curve = curve or fresh.thrust
        else:
            if curve is None:
                curve = fit_vehicle_model(list(flights.values()), None, names=list(flights)).thrust
            rows = recorded_dataset(list(flights.values()), vehicle, curve, names=list(flights))
            fresh = model.refitted(rows)
        made.append((label, fresh))
    return made


def _settings(model: VehicleModel, flights: int) -> FitSettings:
    """Settings that fit the same kind of model: signal, powers and voltage of its thrust curve, kinds of drag.

    A fitted voltage exponent is fitted again to two flights or more; one flight does not determine it.
    """
    curve = model.thrust
    return FitSettings(
        signal=curve.signal, reference_voltage=curve.reference_voltage,
        voltage_exponent=None if curve.voltage_exponent_error and flights > 1 else curve.voltage_exponent,
        powers=tuple(int(p) for p in curve.powers), loss=curve.loss, kinds=tuple(model.models),
        induced=model.blade_element is None or isinstance(model.blade_element.momentum, tuple),
    )  # fmt: skip


def _seen(made: Sequence[Predictor], tested: Sequence[str]) -> list[str]:
    """A warning for every flight that a model was fitted to."""
    notes = []
    for one in made:
        fitted = {Path(name).stem for name in one.seen}
        for name in tested:
            if name in fitted:
                notes.append(
                    f"warning: {name} is one of the flights that {one.name} was fitted to, so this is not a test"
                )
    return notes


def _rollouts(
    predicted: Sequence[tuple[Predictor, FlightRows]], horizons: Sequence[float], vehicle: Vehicle
) -> list[dict[str, Any]]:
    """Open loop with measured attitude; with all 13 states too where the log has a signal per rotor."""
    tracks = [Track(one, predictor, vehicle.gravity) for predictor, one in predicted]
    records = [row for tracked in (False, True) for row in rollout_errors(tracks, horizons, tracked=tracked)]
    curves = [predictor.curve for predictor, _ in predicted]
    if all(curve.signal != "thrust_acceleration" and curve.rotors == vehicle.n_rotors for curve in curves):
        for mode in TURNING:
            turned = [track for track in tracks if mode != "torque" or track.predictor.torque is not None]
            records += rollout_errors(turned, horizons, tracked=True, vehicle=vehicle, mode=mode)
    return records


def _write(report: dict[str, Any], found: Sequence[Residuals], out: Path, figures: bool, force: bool) -> dict[str, str]:
    import json

    record = {key: value for key, value in report.items() if key not in ("lines", "files")}
    files = {"report": str(out / REPORT_FILE)}
    write_text(out / REPORT_FILE, json.dumps(record, indent=1, default=str) + "\n", force=force)
    if figures:
        from quadexp.report.model_figures import validation_figures
        from quadexp.report.style import save

        files |= {name: str(save(figure, out / name)) for name, figure in validation_figures(report).items()}
    if not record["rows"]:
        raise DataError("validate: no rows")
    return files
