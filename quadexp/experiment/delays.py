"""Age of the estimate, dead time and lag of the commands of recorded flights, and the settings that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.control.delay.moments import LARGEST_AGE, Moments, Stream
from quadexp.control.delay.timing import LARGEST, Delays, Search
from quadexp.errors import DataError, UsageError
from quadexp.experiment.vehicle_of import own_vehicle
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.models.samples import READINGS
from quadexp.parts.options import Folders
from quadexp.physics.state import STATE_COLUMNS
from quadexp.physics.vehicle import Vehicle
from quadexp.writer import check_output

EVEN = 1e-3  # share of a period by which samples may be uneven
NOTHING = 1.5e-3  # s: less than this is no delay that is worth a setting
LIKELY = 20.0  # log likelihood less the best, down to which candidates are drawn
PROFILED, BESIDE = 51, 2  # candidates of a delay in a figure; of them on each side of the likely ones


def identify_delays(
    paths: Sequence[Path], vehicle: Vehicle | None, conf: Folders, figure: Path | None = None
) -> dict[str, Any]:
    """{"flights": a record of each, "lines": the report}.

    vehicle: None: that recorded in the flights. figure: where to draw the search in the only flight, without suffix.
    Raises DataError where a flight lacks something, UsageError where its vehicle is not known.
    """
    if not paths:
        raise UsageError("identify: no flight given")
    if figure is not None and len(paths) > 1:
        raise UsageError(f"identify --figure: draws one flight, {len(paths)} are given")
    if figure is not None:
        check_output(figure.with_suffix(".svg"), force=True)
    records, lines = [], list[str]()
    for path in paths:
        flight = read_flight(path, whole=True)
        flown = vehicle or own_vehicle(flight, conf)
        if flown is None:
            raise UsageError(f"{path}: its vehicle is not known here; name it: --vehicle NAME")
        search = Search(Moments(told(flight, str(path)), flown))
        delays = search.find()
        if figure is not None:
            _draw(search, delays, figure)
        settings = overrides(delays)
        records.append({"path": str(path), **asdict(delays), "overrides": settings})
        lines += [f"{path}", *(f"  {line}" for line in report(delays)), f"  set: {' '.join(settings) or 'nothing'}"]
    return {"flights": records, "lines": lines}


def _draw(search: Search, delays: Delays, path: Path) -> None:
    """Write the figure of a search, as SVG and PNG: of every delay its candidates (s) where they are likely at all,
    their log likelihood less the best, and the result; dead time and lag each with the best of the other."""
    from quadexp.report.flight_figures import Profile, delay_figure  # slow to import
    from quadexp.report.style import save

    ages = np.linspace(0.0, LARGEST_AGE, PROFILED)
    ages = _near(ages, search.age_likelihood(ages))
    dead_times, lags = (np.linspace(0.0, largest, PROFILED) for largest in LARGEST[:2])

    def likelihood() -> np.ndarray:
        return np.array([[-search.cost(np.array([d, lag, search.rates_age])) for lag in lags] for d in dead_times])

    rough = likelihood()
    dead_times, lags = _near(dead_times, rough.max(axis=1)), _near(lags, rough.max(axis=0))
    fine = likelihood()
    fine -= fine.max()
    profiles = [
        Profile("age of the state", ages, search.age_likelihood(ages), delays.age, delays.age_error),
        Profile("dead time of the commands", dead_times, fine.max(axis=1), delays.dead_time, delays.dead_time_error),
        Profile("lag of the motors", lags, fine.max(axis=0), delays.lag, delays.lag_error),
    ]
    save(delay_figure(profiles), path)


def _near(candidates: np.ndarray, likelihood: np.ndarray) -> np.ndarray:
    """As many candidates where these are likely, and beside."""
    likely = np.flatnonzero(likelihood > likelihood.max() - LIKELY)
    ends = candidates[max(likely[0] - BESIDE, 0)], candidates[min(likely[-1] + BESIDE, len(candidates) - 1)]
    return np.linspace(*ends, len(candidates))


def told(flight: Flight, name: str) -> Stream:
    """What the controller of a flight was told and has sent. Raises DataError where the flight does not say."""
    t = np.asarray(flight.t, float)
    period = np.diff(t)
    if len(t) < 2 or np.ptp(period) > EVEN * period.mean():
        raise DataError(f"{name}: delays are found in samples that are evenly spaced; these are not")
    if not flight.n_rotors:
        raise DataError(f"{name}: delays are found from the commands of the rotors (u_0, .. in N), and it has none")
    missing = [column for column in READINGS if column not in flight.columns]
    if missing:
        raise DataError(f"{name}: delays are found from the accelerometer, and {', '.join(missing)} are not in it")
    estimated = tuple(f"est_{column}" for column in STATE_COLUMNS)
    state = flight.stack(estimated if estimated[0] in flight.columns else STATE_COLUMNS)
    return Stream(t, state, flight.stack(READINGS), flight.input)


def report(delays: Delays) -> list[str]:
    """In words, a line each."""

    def line(name: str, value: float, error: float, known: bool) -> str:
        if not known:
            return f"{name}: this flight does not tell (standard error {1e3 * error:.1f} ms); faster turns would"
        return f"{name}: {1e3 * value:.1f} ms, standard error {1e3 * error:.1f} ms"

    lines = [line("age of position, velocity and attitude", delays.age, delays.age_error, delays.age_known)]
    if delays.age_known and delays.age > NOTHING:
        lines.append(f"the body rates are {'fresh' if delays.gyro_fresh else 'as old'}")
    known = delays.commands_known
    lines.append(line("dead time of the commands", delays.dead_time, delays.dead_time_error, known))
    return [*lines, line("time constant of the motors", delays.lag, delays.lag_error, known)]


def overrides(delays: Delays) -> list[str]:
    """The settings that make these delays good, as far as they are known."""
    settings = list[str]()
    if delays.commands_known:
        commands = {"dead_time": delays.dead_time, "motor_lag": delays.lag}
        settings += [f"controller.{key}={value:.3f}" for key, value in commands.items() if value > NOTHING]
    if delays.age_known and delays.age > NOTHING:
        settings += [f"delay={'strapdown' if delays.gyro_fresh else 'prediction'}", f"delay.time={delays.age:.3f}"]
    return settings
