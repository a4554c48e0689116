"""From flight files to what they tell of the vehicle, by one of three methods.

rls         Lei & Li's recursive least squares on the blade-element model, flight by flight: needs rotor speeds and the
            rotors' geometry; gives C_d0, C_la and C_D.
regression  thrust curve, drag and lumped blade-element coefficients over all flights together: needs a signal of the
            thrust; gives a vehicle model, a checkpoint with report and figures.
delays      age of the estimate, dead time and lag of the commands, and the settings that follow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace as with_changes

from quadexp.control.delay.moments import LARGEST_AGE
from quadexp.control.delay.timing import LARGEST, Delays, Search, Stream, moments_of
from quadexp.errors import DataError, UsageError
from quadexp.experiment.vehicle_of import own_vehicle, recorded_vehicle, refuse_repeated, vehicle_named
from quadexp.log.schema import Flight
from quadexp.log.store import (
    check_attitude,
    check_finite,
    check_order,
    check_whole,
    column_names,
    read_flight,
    read_table,
    write_table,
)
from quadexp.models.blade_element import Identification, identify_flight
from quadexp.models.checkpoint import save_model
from quadexp.models.rls import RLSSettings
from quadexp.models.samples import QUATERNION, Samples, gather_to_fit, rotor_columns
from quadexp.models.terms import momentum_of
from quadexp.models.vehicle_model import (
    HOVER_INFLOW,
    FitSettings,
    VehicleModel,
    best_level,
    compare_curves,
    fit_level,
    fit_vehicle_model,
    flight_by_flight,
    selection,
)
from quadexp.physics.state import STATE_COLUMNS
from quadexp.physics.vehicle import Vehicle
from quadexp.provenance import provenance, versions
from quadexp.writer import check_output

METHODS = ("rls", "regression", "delays")
LEAST_IMPROVEMENT = 0.02  # relative, of the held-out error along z: another thrust curve replaces c_1, c_2 from here on
EXPONENT_IMPROVEMENT = 0.1  # the same, for a fitted voltage exponent to replace 1
EXPONENTS = (0.5, 1.5)  # plausible voltage exponents of a motor; outside, flights differ in something else
OTHER_LOSS_SAMPLES = 100_000  # used by the fit with the other loss; more are thinned evenly
NO_INDUCED = "blade element without induced velocity: its error on held-out flights is smaller than with it"
ACCELEROMETER = ("acc_x", "acc_y", "acc_z")
EVEN = 1e-3  # share of a period by which samples may be uneven
NOTHING = 1.5e-3  # s: less than this is no delay that is worth a setting
LIKELY = 20.0  # log likelihood less the best, down to which candidates are drawn
PROFILED, BESIDE = 51, 2  # candidates of a delay in a figure; of them on each side of the likely ones


class Choice(NamedTuple):
    """A method, and why it was chosen."""

    method: str
    reason: str


def choose_method(paths: Sequence[Path], asked: str | None, vehicle: Vehicle | None) -> Choice:
    """rls where the flights have rotor speeds and the rotors' geometry is known, else regression.

    vehicle: None: that recorded in the flights. Raises UsageError for an unknown method.
    """
    if asked is not None:
        if asked not in METHODS:
            raise UsageError(f"identify --method: '{asked}' is none of {', '.join(METHODS)}")
        return Choice(asked, "as asked")
    if not paths:
        raise UsageError("identify: no flight given")
    for path in paths:
        names, record = column_names(path, "flight")
        flight = Flight(dict.fromkeys(names, np.empty(0)), record)
        if not rotor_columns(flight, "rotor_speed"):
            return Choice("regression", f"{path} has no rotor speeds")
        flown = vehicle or own_vehicle(flight)
        if flown is not None and flown.rotor is None:
            return Choice("regression", f"the geometry of {flown.name}'s rotors is not known")
        if flown is None and flight.metadata.get("recorded"):
            return Choice("regression", f"{path} is of a vehicle that is not in the configuration")
    return Choice("rls", "rotor speeds and the rotors' geometry are known")


def read_recorded(path: Path) -> Flight:
    """Read a flight that may lack commanded thrusts, as a log does. Raises DataError unless time, attitude and velocity
    are finite, time increases and no sample was left out."""
    needed = ("t", *QUATERNION, "v_x", "v_y", "v_z")
    columns, record = read_table(path, "flight", required=needed)
    check_finite(columns, needed, str(path))
    check_attitude(columns, str(path))
    check_whole(record, str(path))
    check_order(columns["t"], str(path))
    return Flight(columns, record)


def identify_files(
    flights: Sequence[Path],
    out: Path,
    *,
    vehicle: str | None = None,
    conf: Path | None = None,
    force: bool = False,
    paper: bool = False,
) -> list[tuple[Path, Identification]]:
    """Identify from every flight and write <out>/<its name>.parquet, all or none.

    vehicle: name in the configuration (or in the folder `conf`); None: that in the flight's metadata.
    paper: the paper's P_0 and unit noise instead of scaled ones. Raises UsageError or DataError.
    """
    if not flights:
        raise UsageError("identify: no flight given")
    paths = [out / f"{path.stem}.parquet" for path in flights]
    refuse_repeated("identify", paths, "two flights named {path.stem} would both be written to {path}")
    for path in paths:
        check_output(path, force=force)
    named = None if vehicle is None else vehicle_named(vehicle, conf)
    results = []
    for path in flights:
        flight = read_flight(path, whole=True)
        settings = RLSSettings() if paper else None
        results.append(
            identify_flight(flight, named or recorded_vehicle(flight, path), settings=settings, name=str(path))
        )
    for path, one in zip(paths, results, strict=True):
        record = {**one.metadata(), "versions": versions(), "provenance": provenance()}
        write_table(path, one.columns(), record, "estimates", force=force)
    return list(zip(paths, results, strict=True))


# --------------------------------------------------------------------------------------------------------- regression
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
    refuse_repeated("identify", [path.resolve() for path in paths])
    stems = [path.stem for path in paths]
    return [path.stem if stems.count(path.stem) == 1 else str(path) for path in paths]


# --------------------------------------------------------------------------------------------------------- delays
def identify_delays(
    paths: Sequence[Path], vehicle: Vehicle | None, conf: Path | None, figure: Path | None = None
) -> dict[str, Any]:
    """{"flights": a record of each, "lines": the report}.

    vehicle: None: that recorded in the flights. figure: where to draw the search in the only flight, without suffix.
    Raises DataError where a flight lacks something, UsageError where its vehicle is not known.
    """
    if not paths:
        raise UsageError("identify: no flight given")
    if figure is not None and len(paths) > 1:
        raise UsageError(f"identify --figure: draws one flight, {len(paths)} are given")
    records, lines = [], list[str]()
    for path in paths:
        flight = read_flight(path, whole=True)
        flown = vehicle or own_vehicle(flight, conf)
        if flown is None:
            raise UsageError(f"{path}: its vehicle is not known here; name it: --vehicle NAME")
        search = Search(moments_of(told(flight, str(path)), flown))
        found = search.all()
        if figure is not None:
            _draw(search, found, flight, figure)
        settings = overrides(found)
        records.append({"path": str(path), **asdict(found), "overrides": settings})
        lines += [f"{path}", *(f"  {line}" for line in report(found)), f"  set: {' '.join(settings) or 'nothing'}"]
    return {"flights": records, "lines": lines}


def _draw(search: Search, found: Delays, flight: Flight, path: Path) -> None:
    """Write the figure of a search, as SVG and PNG; what draws is slow to import."""
    from quadexp.report.flight_figures import Profile, delay_figure
    from quadexp.report.style import save

    profiles = [Profile(*one) for one in candidates_of(search, found)]
    save(delay_figure(profiles, flight.columns, true_delays(flight)), path)


def candidates_of(search: Search, found: Delays) -> list[tuple[str, np.ndarray, np.ndarray, float, float]]:
    """Of every delay that was looked for: name, candidates (s) where they are likely at all and their log likelihood
    less the best, what was found and its standard error (s); dead time and lag each with the best of the other."""
    ages = np.linspace(0.0, LARGEST_AGE, PROFILED)
    ages = _near(ages, search.age_likelihood(ages))
    dead_times, lags = (np.linspace(0.0, largest, PROFILED) for largest in LARGEST[:2])

    def likelihood() -> np.ndarray:
        return np.array([[-search.cost(np.array([d, lag, search.rates_age])) for lag in lags] for d in dead_times])

    rough = likelihood()
    dead_times, lags = _near(dead_times, rough.max(axis=1)), _near(lags, rough.max(axis=0))
    fine = likelihood()
    fine -= fine.max()
    return [
        ("age of the state", ages, search.age_likelihood(ages), found.age, found.age_error),
        ("dead time of the commands", dead_times, fine.max(axis=1), found.dead_time, found.dead_time_error),
        ("lag of the motors", lags, fine.max(axis=0), found.lag, found.lag_error),
    ]


def _near(candidates: np.ndarray, likelihood: np.ndarray) -> np.ndarray:
    """As many candidates where these are likely, and beside."""
    likely = np.flatnonzero(likelihood > likelihood.max() - LIKELY)
    ends = candidates[max(likely[0] - BESIDE, 0)], candidates[min(likely[-1] + BESIDE, len(candidates) - 1)]
    return np.linspace(*ends, len(candidates))


def true_delays(flight: Flight) -> dict[str, float]:
    """What the world of a simulated flight states, by the columns of delay=identified (s); empty of other flights."""
    config = flight.metadata.get("config") or {}
    places = {"delay_time": ("estimator", "delay"), "delay_dead_time": ("link", "latency")}
    places |= {"delay_lag": ("actuator", "time_constant_up")}
    if not all(group in config for group, _ in places.values()):
        return {}
    return {name: float(config[group].get(key) or 0.0) for name, (group, key) in places.items()}


def told(flight: Flight, name: str) -> Stream:
    """What the controller of a flight was told and has sent. Raises DataError where the flight does not say."""
    t = np.asarray(flight.t, float)
    period = np.diff(t)
    if len(t) < 2 or np.ptp(period) > EVEN * period.mean():
        raise DataError(f"{name}: delays are found in samples that are evenly spaced; these are not")
    if not flight.n_rotors:
        raise DataError(f"{name}: delays are found from the commands of the rotors (u_0, .. in N), and it has none")
    missing = [column for column in ACCELEROMETER if column not in flight.columns]
    if missing:
        raise DataError(f"{name}: delays are found from the accelerometer, and {', '.join(missing)} are not in it")
    estimated = tuple(f"est_{column}" for column in STATE_COLUMNS)
    state = flight.stack(estimated if estimated[0] in flight.columns else STATE_COLUMNS)
    return Stream(t, state, flight.stack(ACCELEROMETER), flight.input)


def report(found: Delays) -> list[str]:
    """In words, a line each."""
    lines = [_line("age of position, velocity and attitude", found.age, found.age_error, found.age_known)]
    if found.age_known and found.age > NOTHING:
        lines.append(f"the body rates are {'fresh' if found.gyro_fresh else 'as old'}")
    both = found.commands_known
    lines.append(_line("dead time of the commands", found.dead_time, found.dead_time_error, both))
    lines.append(_line("time constant of the motors", found.lag, found.lag_error, both))
    return lines


def _line(name: str, value: float, error: float, known: bool) -> str:
    if not known:
        return f"{name}: this flight does not tell (standard error {_ms(error)}); faster turns would"
    return f"{name}: {_ms(value)}, standard error {_ms(error)}"


def overrides(found: Delays) -> list[str]:
    """The settings that make these delays good, as far as they are known."""
    settings = list[str]()
    if found.commands_known:
        if found.dead_time > NOTHING:
            settings.append(f"controller.dead_time={found.dead_time:.3f}")
        if found.lag > NOTHING:
            settings.append(f"controller.motor_lag={found.lag:.3f}")
    if found.age_known and found.age > NOTHING:
        settings += [f"delay={'strapdown' if found.gyro_fresh else 'prediction'}", f"delay.time={found.age:.3f}"]
    return settings


def _ms(time: float) -> str:
    return f"{1e3 * time:.1f} ms"
