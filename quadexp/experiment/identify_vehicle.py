"""From flight files to an identified vehicle model: model.json, the report, the series of estimates and figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.experiment.identify import own_vehicle, read_recorded
from quadexp.experiment.provenance import provenance, versions
from quadexp.flight.schema import Flight
from quadexp.flight.store import check_output, write_table
from quadexp.identify.checkpoint import save_model
from quadexp.identify.lumped import momentum_of
from quadexp.identify.recursion import Recursion, recurse
from quadexp.identify.samples import Samples, choose_signal, gather
from quadexp.identify.selection import best_level, compare_curves, flight_by_flight, selection
from quadexp.identify.vehicle_fit import AxisFit, FitSettings, fit_level, fit_vehicle_model
from quadexp.identify.vehicle_model import VehicleModel
from quadexp.vehicle import Vehicle

ESTIMATES_FILE = "estimates.parquet"
LEAST_IMPROVEMENT = 0.02  # of the held-out error along z, below which the thrust curve c_1, c_2 stays
RECURSION_TOLERANCE = 1e-6  # standard errors between the last recursive estimate and the batch's


@dataclass(frozen=True)
class VehicleIdentification:
    """What was found. series: model kind -> axis -> recursion; samples: what they run over. report: JSON-able."""

    model: VehicleModel
    samples: Samples
    series: dict[str, dict[str, Recursion]]
    report: dict[str, Any]

    def columns(self) -> dict[str, np.ndarray]:
        """The series of estimates as named columns, `<model>_<term>_<axis>` and `std_...` beside it."""
        first = next(iter(next(iter(self.series.values())).values()))
        columns = {"t": elapsed(self.samples)[first.row], "flight": self.samples.flight[first.row].astype(np.int32)}
        for kind, axes in self.series.items():
            for recursion in axes.values():
                for j, name in enumerate(recursion.names):
                    columns[f"{kind}_{name}"] = recursion.coefficients[:, j].copy()
                    columns[f"std_{kind}_{name}"] = recursion.errors[:, j].copy()
        return columns


def elapsed(samples: Samples) -> np.ndarray:
    """Time over all flights, one put behind the other, (k,) (s)."""
    step = np.diff(samples.time, prepend=samples.time[0])
    usual = float(np.median(step[1:]))
    step[np.r_[True, samples.segment[1:] != samples.segment[:-1]]] = usual
    return np.cumsum(step) - usual


def identify_vehicle(
    flights: Sequence[Flight],
    names: Sequence[str],
    vehicle: Vehicle | None = None,
    settings: FitSettings | None = None,
    *,
    choose_curve: bool = True,
) -> VehicleIdentification:
    """Fit, compare, and run the same regressors through recursive least squares.

    names: one a flight, each another. choose_curve: let flights left out choose among the thrust curves on motor
    commands, where settings.powers does not say. Raises DataError, UsageError.
    """
    settings = settings or FitSettings()
    samples = gather(flights, choose_signal(flights, settings.signal), names)
    momentum = momentum_of(vehicle, settings.mass, settings.radius)
    curves = compare_curves(samples, settings) if settings.powers is None else []
    if curves and choose_curve:
        settings = replace(settings, powers=_chosen(curves))
    ladder = selection(samples, settings, momentum)
    model = fit_vehicle_model(flights, vehicle, settings, names=names, samples=samples, best=best_level(ladder))
    model = replace(model, versions=versions())
    squares = replace(settings, loss="squares")
    kappas = {kind: momentum if isinstance(one.momentum, tuple) else 0.0 for kind, one in model.models.items()}
    fits = {kind: fit_level(kind, samples, squares, kappa).axes for kind, kappa in kappas.items()}
    series = {kind: {one.axis: recurse(one.design, one.target, one.found) for one in fits[kind]} for kind in fits}
    report: dict[str, Any] = {
        "kind": "vehicle_model", "vehicle": model.vehicle, "dataset": model.dataset, "signal": samples.kind,
        "thrust": str(model.thrust), "models": {kind: one.rows() for kind, one in model.models.items()},
        "other_loss": _other_loss(samples, settings), "flights": flight_by_flight(samples, settings),
        "curves": curves, "selection": ladder, "best": model.best, "notes": list(model.notes),
        "recursion": _agreement(fits, series),
    }  # fmt: skip
    return VehicleIdentification(model, samples, series, report)


def _chosen(curves: Sequence[Mapping[str, Any]]) -> tuple[int, ...] | None:
    """Powers of the curve (voltage to the first power) that errs least on flights left out; None for the usual one."""
    scored = {tuple(c["powers"]): c["held_out"] for c in curves if c["voltage"] != "V^g" and c["held_out"] is not None}
    with_voltage = {tuple(c["powers"]): c["held_out"] for c in curves if c["voltage"] == "V" and c["held_out"]}
    scored = with_voltage or scored
    if (1, 2) not in scored:
        return min(scored, key=scored.__getitem__) if scored else None
    best = min(scored, key=scored.__getitem__)
    return best if scored[best] < (1 - LEAST_IMPROVEMENT) * scored[1, 2] else None


def _other_loss(samples: Samples, settings: FitSettings) -> dict[str, Any]:
    """Linear drag by the other loss: where the two differ by more than their errors, outliers decide."""
    other = replace(settings, loss="huber" if settings.loss == "squares" else "squares")
    return {"loss": other.loss, "rows": fit_level("linear", samples, other).terms.rows()}


def _agreement(fits: Mapping[str, Sequence[AxisFit]], series: Mapping[str, Mapping[str, Recursion]]) -> float:
    """Largest difference between the recursive estimates at the end and the batch's, in standard errors."""
    worst = 0.0
    for kind, axes in fits.items():
        for one in axes:
            off = series[kind][one.axis].coefficients[-1] - one.found.coefficients
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
    found = identify_vehicle(flights, names, vehicle or own_vehicle(flights[0], conf), settings)
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
