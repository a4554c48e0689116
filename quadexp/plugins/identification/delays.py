"""Age of the estimate, dead time and lag of the commands of flights, and the settings that follow.

The age is found by accelerometer and gyroscope and needs no commands (ages.py). Dead time and lag are those of the
measured rotor speeds behind the commands where there are such, else of the specific force; commands may have any unit
(plugins/logs/command_lag.py). A simulated flight whose accelerometer does not tell them has those that a data set of
`quadexp collect` takes (rotor_thrust.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError, UsageError
from quadexp.log.runs import longest
from quadexp.log.schema import Flight, is_recorded
from quadexp.log.store import read_flight
from quadexp.models.dataset import as_told, transitions
from quadexp.models.residual import VELOCITY
from quadexp.parts.options import Folders
from quadexp.physics.vehicle import GRAVITY, Vehicle
from quadexp.plugins.identification.ages import Age, Stream, age_of_rates, age_of_state, integral_of_force
from quadexp.plugins.identification.held_commands import HeldCommands, Timing
from quadexp.plugins.identification.rotor_thrust import fit_timing
from quadexp.plugins.logs.command_lag import FINE, CommandLag, find_lag
from quadexp.plugins.logs.samples import COMMANDS, QUATERNION, RATES, READINGS, check_columns, gather, rotor_columns
from quadexp.plugins.logs.vehicle_of import own_vehicle
from quadexp.writer import check_output

UNEVEN = 1e-3  # share of a period by which samples may be uneven
MOST_SEARCHED = 3  # flights of a data set
KNOWN = 0.005  # s, standard error up to which a delay counts as known
NOTHING = 1.5e-3  # s: less than this is no delay that is worth a setting
SUM_SHARE = 0.25  # of dead time and lag together, by which their sum may be off to be worth a setting
NORMAL = 1.96  # standard errors of half a 95 % interval
LONGEST_STEP = 1.5  # medians; a longer one is a gap
TRANSITIONS = "the changes of the state"
TOO_SHORT = "too short or too slow"


@dataclass(frozen=True)
class Delays:
    """What was found, s; the standard error of each behind it. age: of position, velocity and attitude. gyro: how much
    younger the given body rate is than the given attitude. dead_time, lag: of the commands."""

    age: float
    age_error: float
    gyro: float
    gyro_error: float
    dead_time: float = 0.0
    dead_time_error: float = np.inf
    lag: float = 0.0
    lag_error: float = np.inf

    @property
    def age_known(self) -> bool:
        """Whether these data tell the age."""
        return self.age_error <= KNOWN

    @property
    def commands_known(self) -> bool:
        """Whether these data tell both what makes the commands late."""
        return max(self.dead_time_error, self.lag_error) <= KNOWN

    @property
    def gyro_fresh(self) -> bool:
        """Whether the given body rate is nearer to now than to the attitude's time."""
        return self.gyro > self.age / 2


class Commands(NamedTuple):
    """late: how late the commands of a flight are, None where it does not tell. by: by what, or why not. rotors: the
    same of every rotor with a measured speed."""

    late: CommandLag | None
    by: str
    rotors: tuple[CommandLag | None, ...] = ()

    @property
    def sum_known(self) -> bool:
        """Whether the flight tells how late the commands are in all, whatever the parts of dead time and lag."""
        if self.late is None or not self.late.late or self.late.at_bound[2]:
            return False
        low, high = self.late.intervals[2]
        return bool((high - low) / 2 <= max(2 * KNOWN, SUM_SHARE * (self.late.dead_time + self.late.lag)))


class Found(NamedTuple):
    """state, rates: the ages as they were searched."""

    delays: Delays
    commands: Commands
    state: Age
    rates: Age


def identify_delays(
    paths: Sequence[Path], vehicle: Vehicle | None, conf: Folders, figure: Path | None = None
) -> dict[str, Any]:
    """{"flights": a record of each, "rows": the same of a table, "lines": the report}.

    vehicle: None: that recorded in the flights. figure: where to draw the search in the only flight, without suffix.
    Raises DataError where a flight lacks something, UsageError where its vehicle is not known.
    """
    if not paths:
        raise UsageError("identify: no flight given")
    if figure is not None:
        if len(paths) > 1:
            raise UsageError(f"identify --figure: draws one flight, {len(paths)} are given")
        check_output(figure.with_suffix(".svg"), force=True)
    records = []
    lines = []
    for path in paths:
        flight = read_flight(path, whole=True, placed=False)
        flown = vehicle or own_vehicle(flight, conf)
        if flown is None and not is_recorded(flight):
            raise UsageError(f"{path}: its vehicle is not known here; name it: --vehicle NAME")
        found = delays_of(flight, str(path), flown)
        settings = overrides(found)
        records.append({"path": str(path), **asdict(found.delays), "overrides": settings})
        split = not found.delays.commands_known and found.commands.sum_known
        sure = " (only the sum of dead time and lag is well known)" if split else ""
        lines += [
            f"{path}",
            *(f"  {line}" for line in report(found)),
            f"  set: {' '.join(settings) or 'nothing'}{sure}",
        ]
        if figure is not None:
            _draw(found, figure)
    rows = [{**record, "overrides": " ".join(record["overrides"])} for record in records]
    return {"flights": records, "rows": rows, "lines": lines}


def delays_of(flight: Flight, name: str, vehicle: Vehicle | None) -> Found:
    """vehicle: None: not known, of a log. Raises DataError where the flight lacks readings or is too short."""
    told = as_told(flight)
    stream = stream_of(told, name)
    commands = commands_of(told, name)
    late = commands.late
    simulated = not is_recorded(flight)
    force = None
    if vehicle is not None and simulated and late is not None:
        timing = Timing(late.lag, late.lag, "thrust", late.dead_time) if late.late else Timing()
        thrust = flight.input.sum(axis=1, keepdims=True) / vehicle.mass
        held = HeldCommands(flight.t, thrust, timing, thrust[0])
        force = integral_of_force(stream, lambda t: held.integral(t)[:, 0], held.value(stream.t)[:, 0])
    state = age_of_state(stream, GRAVITY if vehicle is None else vehicle.gravity, force)
    rates = age_of_rates(stream)
    delays = Delays(state.value, state.error, rates.value, rates.error)
    if late is not None:
        errors = np.diff(late.intervals)[:2, 0] / (2 * NORMAL)
        errors[late.at_bound[:2] | (not late.late)] = np.inf
        delays = replace(delays, dead_time=late.dead_time, lag=late.lag)
        delays = replace(delays, dead_time_error=float(errors[0]), lag_error=float(errors[1]))
    unknown = not (delays.commands_known or commands.sum_known)
    if vehicle is not None and simulated and delays.age_known and unknown:
        by_transitions = _by_transitions(told, vehicle, delays, late)
        if by_transitions is not None:
            delays = by_transitions
            commands = Commands(late, TRANSITIONS)
    return Found(delays, commands, state, rates)


def stream_of(flight: Flight, name: str) -> Stream:
    """The longest stretch of a flight without a gap. Raises DataError where a reading is missing or samples are not
    evenly spaced."""
    first = 0 if is_recorded(flight) else 1  # which has no reading yet
    check_columns(flight, name, ("t", *QUATERNION, *VELOCITY, *RATES, *READINGS), first)
    t = np.asarray(flight.t, float)
    steps = np.diff(t)
    begin, end = longest(steps[first:] < LONGEST_STEP * np.median(steps))
    rows = slice(first + begin, first + end + 1)
    steps = np.diff(t[rows])
    if np.ptp(steps) > UNEVEN * steps.mean():
        raise DataError(f"{name}: delays are found in samples that are evenly spaced; these are not")
    attitude = Rotation.from_quat(flight.stack(QUATERNION)[rows], scalar_first=True)
    velocity = flight.stack(VELOCITY)[rows]
    return Stream(t[rows], velocity, attitude, flight.stack(RATES)[rows], flight.stack(READINGS)[rows])


def commands_of(flight: Flight, name: str) -> Commands:
    """Dead time and lag of the rotor speeds behind the commands where both were measured, else of the force."""
    kind = next((kind for kind in COMMANDS if rotor_columns(flight, kind)), None)
    if kind is None:
        return Commands(None, f"none of {', '.join(COMMANDS)} is in the log")
    samples = gather([flight], kind, [name])
    columns = rotor_columns(flight, "rotor_speed")
    if len(columns) != samples.signal.shape[1]:
        return Commands(samples.command_lag(), f"{kind} and the specific force")
    squares = flight.stack(columns)[-len(samples) :].astype(float) ** 2
    still = np.zeros((len(samples), 3))

    def behind(signal: np.ndarray, square: np.ndarray) -> CommandLag | None:
        return find_lag(samples.time, samples.segment, signal, square, still, samples.held)

    rotors = [behind(samples.signal[:, [i]], square) for i, square in enumerate(squares.T)]
    return Commands(behind(samples.signal, squares.sum(axis=1)), "the rotor speeds", tuple(rotors))


def _by_transitions(flight: Flight, vehicle: Vehicle, delays: Delays, late: CommandLag | None) -> Delays | None:
    """Dead time and lag by the changes of the state, within what the accelerometer allows; None where these do not tell
    either."""
    try:
        timing = fit_timing([flight], vehicle, [transitions(flight, vehicle)]).timing
    except DataError:  # too short
        return None
    if timing.measured or timing.is_ideal:
        return None
    dead_time = max(timing.delay - delays.age, 0.0)
    lag = timing.lag
    if late is not None:
        dead_time, lag = np.clip([dead_time, lag], *late.intervals[:2].T).tolist()
    error = max(KNOWN, delays.age_error)  # the transitions are given to about a quarter of a period
    return replace(delays, dead_time=dead_time, dead_time_error=error, lag=lag, lag_error=error)


def timing_by_accelerometer(flights: Sequence[Flight], vehicle: Vehicle, *, of_estimate: bool) -> Timing | None:
    """Dead time and lag of the commands of simulated flights by their accelerometers; None where these do not tell.

    of_estimate: whether the state is what the controller was given, whose age then adds to the dead time.
    """
    known = []
    for flight in flights[:MOST_SEARCHED]:
        try:
            delays = delays_of(flight, "", vehicle).delays
        except DataError:
            continue
        if delays.commands_known and delays.age_known:
            known.append((delays.lag, delays.dead_time + of_estimate * delays.age))
    if not known:
        return None
    lag, delay = np.mean(known, axis=0)
    return Timing(float(lag), float(lag), "thrust", float(delay))


def _draw(found: Found, path: Path) -> None:
    """Write the figure of a search, as SVG and PNG: of every delay its candidates (s), their log likelihood less the
    best, and the result; dead time and lag each with the best of the other."""
    from quadexp.plugins.drawing.style import save
    from quadexp.plugins.identification.figures import Profile, delay_figure

    delays = found.delays
    late = found.commands.late
    state = found.state
    profiles = [Profile("age of the state", state.tried, state.likelihood, delays.age, delays.age_error)]
    if late is not None:
        names = ("dead time of the commands", "lag of the motors")
        values = ((delays.dead_time, delays.dead_time_error), (delays.lag, delays.lag_error))
        for axis, (name, value) in enumerate(zip(names, values, strict=True)):
            likelihood = late.likelihood.max(axis=1 - axis)
            profiles.append(Profile(name, FINE * np.arange(len(likelihood)), likelihood, *value))
    save(delay_figure(profiles), path)


def report(found: Found) -> list[str]:
    """In words, a line each."""
    delays = found.delays
    late, by, rotors = found.commands
    age = "age of position, velocity and attitude"
    if delays.age_known:
        lines = [f"{age}: {1e3 * delays.age:.1f} ms, standard error {1e3 * delays.age_error:.1f} ms"]
    else:
        error = f"standard error {1e3 * delays.age_error:.1f} ms"
        lines = [f"{age}: not found in this flight ({error}); fly faster turns"]
    if delays.age_known and delays.age > NOTHING:
        lines.append(f"the body rates are {'fresh' if delays.gyro_fresh else 'as old'}")
    if by == TRANSITIONS:
        values = f"dead time {1e3 * delays.dead_time:.1f} ms, lag {1e3 * delays.lag:.1f} ms"
        lines.append(f"commands, by {by}: {values}, standard error {1e3 * delays.lag_error:.1f} ms")
    elif late is None:
        lines.append(f"dead time and lag of the commands: {by if not rotors else TOO_SHORT}")
    else:
        seen = str(late) if late.late else f"none is seen; {late}"
        lines.append(f"commands, by {by}, 95 % intervals: {seen}")
    return lines + [f"rotor {i}: {rotor}" for i, rotor in enumerate(rotors) if rotor is not None]


def overrides(found: Found) -> list[str]:
    """The settings that make these delays good, as far as they are known."""
    delays = found.delays
    settings = list[str]()
    if delays.commands_known or found.commands.sum_known:
        commands = {"dead_time": delays.dead_time, "motor_lag": delays.lag}
        settings += [f"timing.{key}={value:.3f}" for key, value in commands.items() if value > NOTHING]
    if delays.age_known and delays.age > NOTHING:
        settings += [f"delay={'strapdown' if delays.gyro_fresh else 'prediction'}", f"timing.age={delays.age:.3f}"]
    return settings
