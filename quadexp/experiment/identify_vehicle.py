"""From flight files to an identified vehicle model: model.json, the report, the series of estimates and figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.experiment.identify import own_vehicle, read_recorded
from quadexp.learn.checkpoint import save_model
from quadexp.learn.lumped import momentum_of
from quadexp.learn.recursion import Recursion, recurse
from quadexp.learn.samples import Samples, choose_signal, gather
from quadexp.learn.selection import STILL, best_level, compare_curves, flight_by_flight, selection
from quadexp.learn.thrust_curve import ThrustCurve
from quadexp.learn.vehicle_fit import (
    AxisFit,
    FitSettings,
    LevelFit,
    curve_beside_quadratic,
    fit_level,
    fit_vehicle_model,
)
from quadexp.learn.vehicle_identification import VehicleIdentification
from quadexp.log.schema import Flight
from quadexp.log.store import check_output, write_table
from quadexp.physics.vehicle import Vehicle
from quadexp.provenance import provenance, versions

ESTIMATES_FILE = "estimates.parquet"
LEAST_IMPROVEMENT = 0.02  # of the held-out error along z, below which the thrust curve c_1, c_2 stays
EXPONENT_IMPROVEMENT = 0.1  # the same, below which the voltage's exponent stays 1
EXPONENTS = (0.5, 1.5)  # of the voltage, that a motor can have; beyond, something else differs between the flights
OTHER_ROWS = 100_000  # that the other loss is tried on
NO_INDUCED = "blade element without induced velocity, which errs less on what was left out than with it"
RECURSION_TOLERANCE = 1e-6  # standard errors between the last recursive estimate and the batch's


def identify_vehicle(
    flights: Sequence[Flight],
    names: Sequence[str],
    vehicle: Vehicle | None = None,
    settings: FitSettings | None = None,
    *,
    choose_curve: bool = True,
    samples: Samples | None = None,
) -> VehicleIdentification:
    """Fit, compare, and run the same regressors through recursive least squares.

    names: one a flight, each another. choose_curve: let flights left out choose among the thrust curves on motor
    commands, where settings.powers does not say. samples: of these flights where they are gathered already; the flights
    need no columns then. Raises DataError, UsageError.
    """
    settings = settings or FitSettings()
    samples = samples or gather(flights, choose_signal(flights, settings.signal), names)
    momentum = momentum_of(vehicle, settings.mass, settings.radius)
    curves = compare_curves(samples, settings) if settings.powers is None else []
    if curves and choose_curve:
        settings = chosen_curve(curves, settings)
    ladder = selection(samples, settings, momentum)
    best = best_level(ladder)
    fitted_with = any(row["level"] == "blade_element" and not row["note"] for row in ladder)
    if fitted_with and best_level(ladder, ("blade_element", STILL)) == STILL:
        settings = replace(settings, induced=False)
    series: dict[str, dict[str, Recursion]] = {}
    apart: list[float] = []

    def through_recursion(kind: str, fit: LevelFit) -> None:
        if settings.loss != "squares":
            kappa = momentum if isinstance(fit.terms.momentum, tuple) else 0.0
            fit = fit_level(kind, samples, replace(settings, loss="squares"), kappa)
        series[kind] = {one.axis: recurse(one.design, one.target, one.found) for one in fit.axes}
        apart.append(_agreement(fit.axes, series[kind]))

    model = fit_vehicle_model(
        flights,
        vehicle,
        settings,
        names=names,
        samples=samples,
        fitted=through_recursion,
        best="blade_element" if best == STILL else best,
    )
    if not settings.induced:
        model = replace(model, notes=(*model.notes, NO_INDUCED))
    model = replace(model, versions=versions())
    report: dict[str, Any] = {
        "kind": "vehicle_model", "vehicle": model.vehicle, "dataset": model.dataset, "signal": samples.kind,
        "thrust": str(model.thrust), "models": {kind: one.rows() for kind, one in model.models.items()},
        "other_loss": _other_loss(samples, settings), "flights": flight_by_flight(samples, settings),
        "curves": curves, "selection": ladder, "best": model.best, "best_row": best, "notes": list(model.notes),
        "recursion": max(apart), "beside_quadratic": _beside_quadratic(samples, settings, model.thrust),
    }  # fmt: skip
    return VehicleIdentification(model, samples, series, report)


def chosen_curve(curves: Sequence[Mapping[str, Any]], settings: FitSettings) -> FitSettings:
    """The settings with the curve of `compare_curves` that errs least on what was left out, halves before flights.

    The usual one, c_1 s + c_2 s^2 of s V/V_ref, stays unless another is better by LEAST_IMPROVEMENT. V^g is fitted
    where that is better by EXPONENT_IMPROVEMENT, with a g in EXPONENTS, on two flights or more.
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
    asked = settings.voltage_exponent != 1.0  # somebody set it, or wants it fitted anyway
    if not asked and by_exponent is not None and by_exponent[key] < (1 - EXPONENT_IMPROVEMENT) * plain[best]:
        settings = replace(settings, powers=tuple(by_exponent["powers"]), voltage_exponent=None)
    return settings


def _other_loss(samples: Samples, settings: FitSettings) -> dict[str, Any]:
    """Linear drag by the other loss: where the two differ by more than their errors, outliers decide."""
    other = replace(settings, loss="huber" if settings.loss == "squares" else "squares")
    return {"loss": other.loss, "rows": fit_level("linear", samples.thinned(OTHER_ROWS), other).terms.rows()}


def _beside_quadratic(samples: Samples, settings: FitSettings, curve: ThrustCurve) -> str | None:
    """The thrust curve where the drag along z is quadratic, None where the flights do not tell."""
    try:
        return str(curve_beside_quadratic(samples, settings, curve))
    except DataError:
        return None


def _agreement(axes: Sequence[AxisFit], series: Mapping[str, Recursion]) -> float:
    """Largest difference between the recursive estimates at the end and the batch's, in standard errors."""
    worst = 0.0
    for one in axes:
        off = series[one.axis].coefficients[-1] - one.found.coefficients
        worst = max(worst, float(np.max(np.abs(off) / one.found.errors)))
    if not worst < RECURSION_TOLERANCE:
        raise DataError(f"identify: recursive and batch estimates end {worst:.2g} standard errors apart")
    return worst


def write_identification(
    found: VehicleIdentification, out: Path, *, force: bool = False, figures: bool = True
) -> dict[str, str]:
    """Write the checkpoint folder with estimates and figures beside it; returns figure name -> file."""
    report = {**found.report, "versions": versions(), "provenance": provenance()}
    save_model(out, found.model, report=report, force=force)
    record = {"flights": list(found.samples.names), "versions": versions(), "provenance": provenance()}
    write_table(out / ESTIMATES_FILE, found.columns(), record, "estimates")
    if not figures:
        return {}
    from quadexp.report.figures import save
    from quadexp.report.identify_figures import draw_identification

    return {name: str(save(figure, out / "figures" / name)) for name, figure in draw_identification(found).items()}


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
    """Read, identify, write. vehicle: None for the flights' own, as far as known. Returns the report, with `lines`.

    Raises UsageError or DataError before anything is written.
    """
    from quadexp.report.identify_lines import identification_lines

    check_output(out, force=force, folder=True)
    names = unique_names(paths)
    flights = [read_recorded(path) for path in paths]
    samples = gather(flights, choose_signal(flights, settings.signal), names)
    flights = [Flight({"t": flight.t[:1]}, flight.metadata) for flight in flights]  # frees their columns
    found = identify_vehicle(flights, names, vehicle or own_vehicle(flights[0], conf), settings, samples=samples)
    drawn = write_identification(found, out, force=force, figures=figures)
    lines = identification_lines(found.model, found.report)
    return {"method": "regression", "out": out, "figures": drawn, **found.report, "lines": lines}


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Stems of the files; raises UsageError where one is given twice: its rows would be fitted while it is left out."""
    resolved = Counter(path.resolve() for path in paths)
    twice = [path for path in paths if resolved[path.resolve()] > 1]
    if twice:
        raise UsageError(f"identify: {twice[0]} is given twice")
    stems = Counter(path.stem for path in paths)
    return [path.stem if stems[path.stem] == 1 else str(path) for path in paths]
