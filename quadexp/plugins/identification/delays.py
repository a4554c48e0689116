"""Age of the estimate, dead time and lag of the commands of flights, and the settings that follow.

Simulated flights know their commands as thrusts: dead time and lag are those by the accelerometer and the turning rates
(timing.py) where these tell, else those that a data set of `quadexp collect` takes (rotor_thrust.py).
Logs have commands of any unit: dead time and lag of the measured rotor speeds behind them where there are such, else of
the specific force (plugins/logs/command_lag.py). The age needs no commands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.experiment.vehicle_of import vehicle_named
from quadexp.log.schema import Flight, is_recorded
from quadexp.log.store import read_flight
from quadexp.models.dataset import as_told, transitions
from quadexp.parts.options import Folders
from quadexp.physics.state import STATE_COLUMNS
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.identification.moments import LARGEST_AGE, Moments, Stream
from quadexp.plugins.identification.rotor_thrust import Timing, fit_timing
from quadexp.plugins.identification.timing import KNOWN, LARGEST, Delays, Search
from quadexp.plugins.logs.command_lag import CommandLag, find_lag
from quadexp.plugins.logs.samples import COMMANDS, READINGS, Samples, gather, rotor_columns
from quadexp.plugins.logs.vehicle_of import own_vehicle
from quadexp.writer import check_output

EVEN = 1e-3  # share of a period by which samples may be uneven
MOST_SEARCHED = 3  # flights of a data set
NOTHING = 1.5e-3  # s: less than this is no delay that is worth a setting
SUM_SHARE = 0.25  # of dead time and lag together, by which their sum may be off to be worth a setting
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
        flight = read_flight(path, whole=True, placed=False)
        flown = vehicle or own_vehicle(flight, conf)
        if flown is None and is_recorded(flight):  # ages and commands of a log say nothing of its vehicle
            flown = vehicle_named("torrente", None)
        if flown is None:
            raise UsageError(f"{path}: its vehicle is not known here; name it: --vehicle NAME")
        if is_recorded(flight):
            if figure is not None:
                raise UsageError("identify --figure: draws the search in a simulated flight, this one is a log")
            delays, said, late = _of_log(flight, str(path), flown)
        else:
            late = None
            search, delays = _of_simulated(flight, str(path), flown)
            said = report(delays)
            if figure is not None:
                _draw(search, delays, figure)
        settings = overrides(delays)
        split = ""
        if late is not None and not delays.commands_known and sum_known(late):
            settings = [*_of_commands(late.dead_time, late.lag), *settings]
            split = " (only the sum of dead time and lag is well known)"
        records.append({"path": str(path), **asdict(delays), "overrides": settings})
        lines += [f"{path}", *(f"  {line}" for line in said), f"  set: {' '.join(settings) or 'nothing'}{split}"]
    return {"flights": records, "lines": lines}


def _of_simulated(flight: Flight, name: str, vehicle: Vehicle) -> tuple[Search, Delays]:
    search = Search(Moments(corrected_stream(flight, name), vehicle))
    delays = search.find()
    if delays.commands_known or not delays.age_known:
        return search, delays
    seen = as_told(flight)
    try:
        timing = fit_timing([seen], vehicle, [transitions(seen, vehicle)]).timing
    except DataError:  # too short
        return search, delays
    if timing.measured or timing.is_ideal:
        return search, delays
    dead_time = max(timing.delay - delays.age, 0.0)
    error = max(KNOWN, delays.age_error)  # the transitions are given to about a quarter of a period
    return search, replace(delays, dead_time=dead_time, dead_time_error=error, lag=timing.lag, lag_error=error)


def timing_by_accelerometer(flights: Sequence[Flight], vehicle: Vehicle, *, of_estimate: bool) -> Timing | None:
    """Dead time and lag of the commands of simulated flights by their accelerometers; None where these do not tell.

    of_estimate: whether the state is what the controller was given, whose age then adds to the dead time.
    """
    known = []
    for flight in flights[:MOST_SEARCHED]:
        try:
            delays = Search(Moments(corrected_stream(flight, ""), vehicle)).find()
        except DataError:
            continue
        if delays.commands_known and delays.age_known:
            known.append((delays.lag, delays.dead_time + of_estimate * delays.age))
    if not known:
        return None
    lag, delay = np.mean(known, axis=0)
    return Timing(float(lag), float(lag), "thrust", float(delay))


def _of_log(flight: Flight, name: str, vehicle: Vehicle) -> tuple[Delays, list[str], CommandLag | None]:
    """Delays of a recorded flight, what to say of them, and dead time and lag as they were found."""
    speeds = rotor_columns(flight, "rotor_speed")
    kind = next((kind for kind in COMMANDS if rotor_columns(flight, kind)), None)
    late, lines = None, list[str]()
    if kind is not None:
        samples = gather([flight], kind, [name])
        if len(speeds) == samples.signal.shape[1]:
            late, lines = _by_speeds(samples, flight.stack(speeds).astype(float))
        else:
            late = samples.command_lag()
    still = replace(flight, columns={**flight.columns, **_no_commands(len(flight), vehicle)})
    ages = Search(Moments(_evenly(still, name), vehicle)).ages()
    if late is None:
        why = "too short or too slow" if kind else f"none of {', '.join(COMMANDS)} is in the log"
        delays = Delays(*ages, 0.0, np.inf, 0.0, np.inf)
        return delays, [*report(delays)[:-2], f"dead time and lag of the commands: {why}"], None
    error = (late.intervals[:, 1] - late.intervals[:, 0]) / (2 * 1.96)
    error[late.at_bound | (not late.late)] = np.inf
    delays = Delays(*ages, late.dead_time, float(error[0]), late.lag, float(error[1]))
    by = "the rotor speeds" if lines else f"{kind} and the specific force"
    sentence = str(late) if late.late else f"none is seen; {late}"
    return delays, [*report(delays)[:-2], f"commands, by {by}, 95 % intervals: {sentence}", *lines], late


def _by_speeds(samples: Samples, speeds: np.ndarray) -> tuple[CommandLag | None, list[str]]:
    """Dead time and lag of measured speeds (k, n) behind their commands: of their sum, and rotor by rotor in words."""
    still = np.zeros((len(samples), 3))

    def behind(signal: np.ndarray, square: np.ndarray) -> CommandLag | None:
        return find_lag(samples.time, samples.segment, signal, square, still, samples.held)

    each = [behind(samples.signal[:, [i]], speeds[:, i] ** 2) for i in range(speeds.shape[1])]
    lines = [f"rotor {i}: {late}" for i, late in enumerate(each) if late is not None]
    return behind(samples.signal, np.sum(speeds**2, axis=1)), lines


def _no_commands(length: int, vehicle: Vehicle) -> dict[str, np.ndarray]:
    return {f"u_{i}": np.zeros(length) for i in range(vehicle.n_rotors)}


def _evenly(flight: Flight, name: str) -> Stream:
    """The longest stretch of a log without a gap."""
    breaks = np.flatnonzero(np.diff(flight.t) > 1.5 * np.median(np.diff(flight.t))) + 1
    rows = max(np.split(np.arange(len(flight)), breaks), key=len)
    return corrected_stream(
        Flight({key: values[rows] for key, values in flight.columns.items()}, flight.metadata), name
    )


def _draw(search: Search, delays: Delays, path: Path) -> None:
    """Write the figure of a search, as SVG and PNG: of every delay its candidates (s) where they are likely at all,
    their log likelihood less the best, and the result; dead time and lag each with the best of the other."""
    from quadexp.plugins.drawing.style import save
    from quadexp.plugins.identification.figures import Profile, delay_figure

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


def corrected_stream(flight: Flight, name: str) -> Stream:
    """What the controller of a flight was given and has sent. Raises DataError where the flight does not say."""
    t = np.asarray(flight.t, float)
    period = np.diff(t)
    if len(t) < 2 or np.ptp(period) > EVEN * period.mean():
        raise DataError(f"{name}: delays are found in samples that are evenly spaced; these are not")
    if not flight.n_rotors:
        raise DataError(f"{name}: delays are found from the commands of the rotors (u_0, .. in N), and it has none")
    missing = [column for column in READINGS if column not in flight.columns]
    if missing:
        raise DataError(f"{name}: delays are found from the accelerometer, and {', '.join(missing)} are not in it")
    prefix = "est_" if f"est_{STATE_COLUMNS[0]}" in flight.columns else ""
    unplaced = np.zeros(len(t))  # the position of a log tells nothing of a delay
    state = np.column_stack([flight.columns.get(f"{prefix}{column}", unplaced) for column in STATE_COLUMNS])
    return Stream(t, state, flight.stack(READINGS), flight.input)


def report(delays: Delays) -> list[str]:
    """In words, a line each."""

    def line(name: str, value: float, error: float, known: bool) -> str:
        if not known:
            return f"{name}: not found in this flight (standard error {1e3 * error:.1f} ms); fly faster turns"
        return f"{name}: {1e3 * value:.1f} ms, standard error {1e3 * error:.1f} ms"

    lines = [line("age of position, velocity and attitude", delays.age, delays.age_error, delays.age_known)]
    if delays.age_known and delays.age > NOTHING:
        lines.append(f"the body rates are {'fresh' if delays.gyro_fresh else 'as old'}")
    known = delays.commands_known
    lines.append(line("dead time of the commands", delays.dead_time, delays.dead_time_error, known))
    return [*lines, line("time constant of the motors", delays.lag, delays.lag_error, known)]


def sum_known(late: CommandLag) -> bool:
    """Whether a log tells how late the commands are in all, whatever the parts of dead time and lag."""
    low, high = late.intervals[2]
    whole = late.dead_time + late.lag
    return late.late and not late.at_bound[2] and (high - low) / 2 <= max(2 * KNOWN, SUM_SHARE * whole)


def _of_commands(dead_time: float, lag: float) -> list[str]:
    commands = {"dead_time": dead_time, "motor_lag": lag}
    return [f"timing.{key}={value:.3f}" for key, value in commands.items() if value > NOTHING]


def overrides(delays: Delays) -> list[str]:
    """The settings that make these delays good, as far as they are known."""
    settings = list[str]()
    if delays.commands_known:
        settings += _of_commands(delays.dead_time, delays.lag)
    if delays.age_known and delays.age > NOTHING:
        settings += [f"delay={'strapdown' if delays.gyro_fresh else 'prediction'}", f"timing.age={delays.age:.3f}"]
    return settings
