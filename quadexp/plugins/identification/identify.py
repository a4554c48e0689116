"""From flight files to what they tell of the vehicle, by one of three methods.

rls         Lei & Li's recursive least squares on the blade-element model, flight by flight: needs rotor speeds and the
            rotors' geometry; gives C_d0, C_la and C_D.
regression  thrust curve, drag and lumped blade-element coefficients over all flights together: needs a signal of the
            thrust; gives a vehicle model, a checkpoint with report and figures.
delays      age of the estimate, dead time and lag of the commands, and the settings that follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow.parquet as pq
from msgspec.structs import replace as with_changes

from quadexp.errors import DataError, UsageError
from quadexp.experiment.vehicle_of import refuse_repeated
from quadexp.log import store
from quadexp.log.schema import Flight
from quadexp.models.checkpoint import save_model
from quadexp.models.dataset import WIND, ResidualDataset, by_axis
from quadexp.models.residual import THRUST, VELOCITY
from quadexp.parts.options import Folders
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.drag_choice import chosen_drag, compare_drag
from quadexp.plugins.identification.comparison import best_level, chosen_curve, compare_curves, selection
from quadexp.plugins.identification.inflow import momentum_of
from quadexp.plugins.identification.recorded import read_recorded
from quadexp.plugins.identification.thrust_curve import ThrustCurve, fit_thrust_samples
from quadexp.plugins.identification.torque_gain import TorqueGain
from quadexp.plugins.identification.vehicle_model import (
    HOVER_INFLOW,
    FitSettings,
    VehicleModel,
    fit_vehicle_model,
    flight_by_flight,
)
from quadexp.plugins.identification.vehicle_numbers import numbers_of
from quadexp.plugins.logs.samples import QUATERNION, RATES, READINGS, SIGNALS, Samples, gather_to_fit, rotor_columns
from quadexp.plugins.logs.vehicle_of import own_vehicle, recorded_vehicle
from quadexp.plugins.papers.lei_li.blade_element import identify_flight
from quadexp.provenance import provenance, versions
from quadexp.writer import check_output

NO_INDUCED = "blade element without induced velocity: its error on held-out flights is smaller than with it"


class Choice(NamedTuple):
    """A method, and why it was chosen."""

    method: str
    reason: str


def choose_method(paths: Sequence[Path], asked: str | None, vehicle: Vehicle | None) -> Choice:
    """rls where the flights have rotor speeds and the rotors' geometry is known, else regression.

    vehicle: None: that recorded in the flights.
    """
    if asked is not None:
        return Choice(asked, "as asked")
    if not paths:
        raise UsageError("identify: no flight given")
    for path in paths:
        record = store.read_metadata(path, "flight")
        names = pq.read_schema(path).names
        flight = Flight(dict.fromkeys(names, np.empty(0)), record)
        if not rotor_columns(flight, "rotor_speed"):
            return Choice("regression", f"{path} has no rotor speeds")
        flown = vehicle or own_vehicle(flight)
        if flown is not None and flown.rotor is None:
            return Choice("regression", f"the geometry of {flown.name}'s rotors is not known")
        if flown is None and flight.metadata.get("recorded"):
            return Choice("regression", f"{path} is of a vehicle that is not in the configuration")
    return Choice("rls", "rotor speeds and the rotors' geometry are known")


def identify_files(
    flights: Sequence[Path], out: Path, *, vehicle: Vehicle | None = None, conf: Folders = None, force: bool = False
) -> dict[str, Any]:
    """Identify from every flight and write <out>/<its name>.parquet, all or none: {out, flights, rows, lines}.

    vehicle: None: that in the flight's metadata, of the configuration or of the folder `conf`.
    Raises UsageError or DataError.
    """
    if not flights:
        raise UsageError("identify: no flight given")
    paths = [out / f"{path.stem}.parquet" for path in flights]
    refuse_repeated("identify", paths, "two flights named {path.stem} would both be written to {path}")
    for path in paths:
        check_output(path, force=force)
    results = []
    for path in flights:
        flight = store.read_flight(path, whole=True)
        results.append(identify_flight(flight, vehicle or recorded_vehicle(flight, path), name=str(path)))
    records = []
    rows = []
    lines = []
    for path, result in zip(paths, results, strict=True):
        record = result.metadata()
        stored = {**record, "versions": versions(), "provenance": provenance()}
        store.write_table(path, result.columns(), stored, "estimates", force=force)
        records.append({"path": path, **record})
        lines += [*result.lines(), path]
        for name, value in record["estimates"].items():
            low, high = record.get("interval_95", {}).get(name, (None, None))
            rows.append({
                "flight": record["flight"],
                "coefficient": name,
                "value": value,
                "low": low,
                "high": high,
                "recursion": record["recursion"][name],
                "path": path,
            })  # fmt: skip
    return {"out": out, "flights": records, "rows": rows, "lines": lines}


# --------------------------------------------------------------------------------------------------------- regression
class VehicleIdentification(NamedTuple):
    """model, samples: the fit and its data. report: JSON-able."""

    model: VehicleModel
    samples: Samples
    report: dict[str, Any]


def identify_vehicle(
    flights: Sequence[Flight], names: Sequence[str], vehicle: Vehicle | None = None,
    settings: FitSettings | None = None, *, samples: Samples | None = None,
) -> VehicleIdentification:  # fmt: skip
    """Fit, and compare models on held-out flights.

    names: one per flight, all different. samples: of these flights, if gathered already; their columns are not needed
    then. Where settings.powers is None the thrust curve on motor commands is selected by held-out flights.
    Raises DataError, UsageError.
    """
    settings = settings or FitSettings()
    samples = samples or gather_to_fit(flights, settings.signal, names)
    momentum = momentum_of(vehicle, settings.radius)
    curves = compare_curves(samples, settings) if settings.powers is None else []
    if curves:
        settings = chosen_curve(curves, settings)
    ladder = selection(samples, settings, momentum)
    fitted = {row["level"] for row in ladder if not row["note"]}
    air = compare_drag(rows_of_samples(samples, settings))
    best = chosen_drag(air)
    if best is None or best not in fitted:
        best = best_level(ladder)
    if "blade_element" in fitted and best_level(ladder, ("blade_element", HOVER_INFLOW)) == HOVER_INFLOW:
        settings = replace(settings, induced=False)
        if best == "blade_element":
            best = HOVER_INFLOW
    kept = "blade_element" if best == HOVER_INFLOW else best
    model = fit_vehicle_model(flights, vehicle, settings, names=names, samples=samples, best=kept)
    torque, notes = torque_of(flights, names, vehicle, samples, model.thrust)
    if not settings.induced:
        notes.append(NO_INDUCED)
    model = with_changes(model, torque=torque, notes=(*model.notes, *notes), versions=versions())
    alone = flight_by_flight(samples, settings)
    numbers = numbers_of(model.thrust, samples, alone, vehicle, torque)
    report = {
        "kind": "vehicle_model", "vehicle": model.vehicle, "dataset": model.dataset, "signal": samples.kind,
        "thrust": str(model.thrust), "models": {kind: terms.records() for kind, terms in model.models.items()},
        "flights": alone, "curves": curves, "air": air, "numbers": numbers,
        "torque": None if torque is None else torque.record(), "selection": ladder, "best": model.best,
        "best_row": best, "notes": list(model.notes),
    }  # fmt: skip
    return VehicleIdentification(model, samples, report)


def rows_of_samples(samples: Samples, settings: FitSettings) -> ResidualDataset:
    """Residual beyond the thrust curve as `quadexp collect` has it, for a vehicle of 1 kg."""
    curve = fit_thrust_samples(samples, settings, intervals=False)[0]
    rotors = curve.of_signal(samples.signal, samples.voltage)
    residual = samples.force - rotors.sum(axis=1)[:, None] * [0, 0, 1]
    columns = {"flight": samples.flight, **by_axis(v=samples.velocity, a=residual)}
    columns |= {f"u_{i}": rotor for i, rotor in enumerate(rotors.T)} | {THRUST: rotors.sum(axis=1)}
    return ResidualDataset(columns, {"recorded": True, "vehicle": {"mass": 1.0}})


def torque_of(
    flights: Sequence[Flight], names: Sequence[str], vehicle: Vehicle | None, samples: Samples, curve: ThrustCurve
) -> tuple[TorqueGain | None, list[str]]:
    """The gain of the rotors' torque, or a note why there is none."""
    from quadexp.plugins.identification.torque import torque_data, torque_gain

    if vehicle is None:
        return None, ["no torque: the vehicle is not known, whose arms it needs"]
    try:
        return torque_gain(torque_data(flights, names, vehicle, samples, curve), vehicle), []
    except DataError as error:
        return None, [f"no torque: {error}"]


def _lean(flight: Flight) -> Flight:
    """The flight with the columns that the torque needs, to free the others."""
    needed = ("t", "segment", "battery_voltage", *QUATERNION, *VELOCITY, *WIND, *READINGS, *RATES)
    kept = {name: column for name, column in flight.columns.items() if name in needed}
    for kind in SIGNALS:
        kept |= {name: flight.columns[name] for name in rotor_columns(flight, kind)}
    return Flight(kept, flight.metadata)


def identify_flights(
    paths: Sequence[Path], out: Path, vehicle: Vehicle | None, settings: FitSettings, *, force: bool, figures: bool,
    conf: Folders,
) -> dict[str, Any]:  # fmt: skip
    """Read, identify, write the checkpoint folder with its figures. vehicle: None: the one recorded in the flights, if
    any. Returns the report, with `rows`, `lines` and `main`, those that matter first.

    Raises UsageError for a file given twice (it would test itself), UsageError or DataError before anything is written.
    """
    from quadexp.plugins.identification.lines import identification_lines, main_lines

    check_output(out, force=force, folder=True)
    refuse_repeated("identify", [path.resolve() for path in paths])
    stems = [path.stem for path in paths]
    names = [path.stem if stems.count(path.stem) == 1 else str(path) for path in paths]
    flights = list(map(read_recorded, paths))
    samples = gather_to_fit(flights, settings.signal, names)
    flights = [_lean(flight) for flight in flights]
    vehicle = vehicle or own_vehicle(flights[0], conf)
    model, _, report = identify_vehicle(flights, names, vehicle, settings, samples=samples)
    save_model(out, model, report={**report, "versions": versions(), "provenance": provenance()}, force=force)
    files = {}
    if figures:
        from quadexp.plugins.drawing.style import save
        from quadexp.plugins.identification.figures import identification_figures

        for name, figure in identification_figures(model, samples).items():
            files[name] = str(save(figure, out / "figures" / name))
    rows = []
    for kind, model_rows in report["models"].items():
        rows += [{"model": kind, **row} for row in model_rows]
    return {
        "out": out, "figures": files, **report, "rows": rows,
        "lines": [*identification_lines(model, report), out], "main": [*main_lines(model, report), out],
    }  # fmt: skip
