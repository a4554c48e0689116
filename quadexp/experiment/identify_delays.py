"""Age of the estimate, dead time and lag of the commands of recorded flights, and the settings that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.control.delay.moments import LARGEST_AGE
from quadexp.control.delay.timing import LARGEST, Delays, Search, Stream, moments_of
from quadexp.errors import DataError, UsageError
from quadexp.experiment.identify import own_vehicle
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.physics.state import STATE_COLUMNS
from quadexp.physics.vehicle import Vehicle

ACCELEROMETER = ("acc_x", "acc_y", "acc_z")
EVEN = 1e-3  # share of a period by which samples may be uneven
NOTHING = 1.5e-3  # s: less than this is no delay that is worth a setting
LIKELY = 20.0  # log likelihood less the best, down to which candidates are drawn
PROFILED, BESIDE = 51, 2  # candidates of a delay in a figure; of them on each side of the likely ones


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
