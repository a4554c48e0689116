"""From flight files to an identified vehicle model: checkpoint, report and figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace as with_changes

from quadexp.errors import DataError, UsageError
from quadexp.experiment.identify import own_vehicle, read_recorded
from quadexp.log.schema import Flight
from quadexp.models.checkpoint import save_model
from quadexp.models.lumped import momentum_of
from quadexp.models.samples import Samples, gather_to_fit
from quadexp.models.selection import HOVER_INFLOW, best_level, compare_curves, flight_by_flight, selection
from quadexp.models.thrust_curve import ThrustCurve
from quadexp.models.vehicle_model import FitSettings, VehicleModel, curve_beside_quadratic, fit_level, fit_vehicle_model
from quadexp.physics.vehicle import Vehicle
from quadexp.provenance import provenance, versions
from quadexp.writer import check_output

LEAST_IMPROVEMENT = 0.02  # relative, of the held-out error along z: another thrust curve replaces c_1, c_2 from here on
EXPONENT_IMPROVEMENT = 0.1  # the same, for a fitted voltage exponent to replace 1
EXPONENTS = (0.5, 1.5)  # plausible voltage exponents of a motor; outside, flights differ in something else
OTHER_LOSS_SAMPLES = 100_000  # used by the fit with the other loss; more are thinned evenly
NO_INDUCED = "blade element without induced velocity: its error on held-out flights is smaller than with it"


class VehicleIdentification(NamedTuple):
    """model, samples: the fit and its data. report: JSON-able."""

    model: VehicleModel
    samples: Samples
    report: dict[str, Any]


def identify_vehicle(
    flights: Sequence[Flight],
    names: Sequence[str],
    vehicle: Vehicle | None = None,
    settings: FitSettings | None = None,
    *,
    samples: Samples | None = None,
) -> VehicleIdentification:
    """Fit, and compare models on held-out flights.

    names: one per flight, all different. samples: of these flights, if gathered already; their columns are not needed
    then. Where settings.powers is None the thrust curve on motor commands is selected by held-out flights.
    Raises DataError, UsageError.
    """
    settings = settings or FitSettings()
    samples = samples or gather_to_fit(flights, settings.signal, names)
    momentum = momentum_of(vehicle, settings.mass, settings.radius)
    curves = compare_curves(samples, settings) if settings.powers is None else []
    if curves:
        settings = chosen_curve(curves, settings)
    ladder = selection(samples, settings, momentum)
    best = best_level(ladder)
    with_inflow = any(row["level"] == "blade_element" and not row["note"] for row in ladder)
    if with_inflow and best_level(ladder, ("blade_element", HOVER_INFLOW)) == HOVER_INFLOW:
        settings = replace(settings, induced=False)
    kept = "blade_element" if best == HOVER_INFLOW else best
    model = fit_vehicle_model(flights, vehicle, settings, names=names, samples=samples, best=kept)
    if not settings.induced:
        model = with_changes(model, notes=(*model.notes, NO_INDUCED))
    model = with_changes(model, versions=versions())
    report: dict[str, Any] = {
        "kind": "vehicle_model", "vehicle": model.vehicle, "dataset": model.dataset, "signal": samples.kind,
        "thrust": str(model.thrust), "models": {kind: terms.records() for kind, terms in model.models.items()},
        "other_loss": _other_loss(samples, settings), "flights": flight_by_flight(samples, settings),
        "curves": curves, "selection": ladder, "best": model.best, "best_row": best, "notes": list(model.notes),
        "beside_quadratic": _beside_quadratic(samples, settings, model.thrust),
    }  # fmt: skip
    return VehicleIdentification(model, samples, report)


def chosen_curve(curves: Sequence[Mapping[str, Any]], settings: FitSettings) -> FitSettings:
    """The settings with the curve of `compare_curves` of least held-out error (by half flights where there are such).

    The default, c_1 s + c_2 s^2 of s V/V_ref, stays unless another is better by LEAST_IMPROVEMENT. V^g is fitted where
    that is better by EXPONENT_IMPROVEMENT, with g within EXPONENTS, on two flights or more.
    """
    key = "halves_out" if any(row["halves_out"] is not None for row in curves) else "held_out"
    scored = {(tuple(row["powers"]), row["voltage"]): row[key] for row in curves if row[key] is not None}
    plain = {powers: error for (powers, voltage), error in scored.items() if voltage == "V"}
    plain = plain or {powers: error for (powers, voltage), error in scored.items() if voltage == "unused"}
    if not plain:
        return settings
    best = min(plain, key=plain.__getitem__)
    if best != (1, 2) and plain[best] < (1 - LEAST_IMPROVEMENT) * plain.get((1, 2), np.inf):
        settings = replace(settings, powers=best)
    motors = [row for row in curves if row["voltage"] == "V^g" and row[key] is not None]
    motors = [row for row in motors if EXPONENTS[0] <= row["exponent"] <= EXPONENTS[1]]
    by_exponent = min(motors, key=lambda row: row[key], default=None)
    explicit = settings.voltage_exponent != 1.0  # set, or to be fitted, by the user
    if not explicit and by_exponent is not None and by_exponent[key] < (1 - EXPONENT_IMPROVEMENT) * plain[best]:
        settings = replace(settings, powers=tuple(by_exponent["powers"]), voltage_exponent=None)
    return settings


def _other_loss(samples: Samples, settings: FitSettings) -> dict[str, Any]:
    """Linear drag with the other loss: where the two differ by more than their errors, outliers matter."""
    other = replace(settings, loss="huber" if settings.loss == "squares" else "squares")
    return {"loss": other.loss, "rows": fit_level("linear", samples.thinned(OTHER_LOSS_SAMPLES), other).terms.records()}


def _beside_quadratic(samples: Samples, settings: FitSettings, curve: ThrustCurve) -> str | None:
    """The thrust curve if drag along z is quadratic, None where the flights do not determine it."""
    try:
        return str(curve_beside_quadratic(samples, settings, curve))
    except DataError:
        return None


def write_identification(
    result: VehicleIdentification, out: Path, *, force: bool = False, figures: bool = True
) -> dict[str, str]:
    """Write the checkpoint folder, with figures in it; returns figure name -> file."""
    report = {**result.report, "versions": versions(), "provenance": provenance()}
    save_model(out, result.model, report=report, force=force)
    if not figures:
        return {}
    from quadexp.report.model_figures import identification_figures
    from quadexp.report.style import save

    figures_by_name = identification_figures(result.model, result.samples).items()
    return {name: str(save(figure, out / "figures" / name, inside=out)) for name, figure in figures_by_name}


def identify_flights(
    paths: Sequence[Path],
    out: Path,
    vehicle: Vehicle | None,
    settings: FitSettings,
    *,
    force: bool = False,
    figures: bool = True,
    conf: Path | None = None,
) -> dict[str, Any]:
    """Read, identify, write. vehicle: None: the one recorded in the flights, if any. Returns the report, with `lines`
    and `main`, those that matter first.

    Raises UsageError or DataError before anything is written.
    """
    from quadexp.report.model_lines import identification_lines, main_lines

    check_output(out, force=force, folder=True)
    names = unique_names(paths)
    flights = [read_recorded(path) for path in paths]
    samples = gather_to_fit(flights, settings.signal, names)
    flights = [Flight({"t": flight.t[:1]}, flight.metadata) for flight in flights]  # to free their columns
    result = identify_vehicle(flights, names, vehicle or own_vehicle(flights[0], conf), settings, samples=samples)
    files = write_identification(result, out, force=force, figures=figures)
    lines = identification_lines(result.model, result.report)
    texts = {"lines": lines, "main": main_lines(result.model, result.report)}
    return {"method": "regression", "out": out, "figures": files, **result.report, **texts}


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Stems of the files, or paths where stems repeat. UsageError for a file given twice: it would test itself."""
    resolved = Counter(path.resolve() for path in paths)
    twice = [path for path in paths if resolved[path.resolve()] > 1]
    if twice:
        raise UsageError(f"identify: {twice[0]} is given twice")
    stems = Counter(path.stem for path in paths)
    return [path.stem if stems[path.stem] == 1 else str(path) for path in paths]
