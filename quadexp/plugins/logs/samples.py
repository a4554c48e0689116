"""Samples for identification: specific force, velocity relative to the air and the rotors' signal.

    f = R^T (dv/dt + g)     specific force, body FLU (m/s^2), as the accelerometer reads it
    v = R^T (v_world - wind)        air-relative body velocity (m/s); wind is zero where the flight has no wind columns

In a simulated flight the reading of row k belongs to the end of the interval over which the command of row k - 1 was
held, so commands are taken one row earlier and the first row, which has no reading yet, is omitted. Such a command is
that of the whole interval [k - 1, k]: at its end in a regression on readings, in its middle where motion is integrated.
A recorded flight has a common clock since its import and is used row by row.

A command that acts late, with the lag of the motors, is L[s] (`delayed`): `gather_to_fit` takes the dead time and lag
that the flights show (command_lag.py), none where these show none.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.log.runs import period_of
from quadexp.log.schema import Flight
from quadexp.models.dataset import WIND, name_of
from quadexp.models.residual import VELOCITY
from quadexp.physics.state import norms
from quadexp.plugins.logs.command_lag import CommandLag, find_lag, lagged

# In order of preference for the thrust.
SIGNALS = {"rotor_speed": "rad/s", "motor_command": "1", "thrust_acceleration": "m/s^2", "u": "N"}
HELD = ("u", "motor_command")  # commands, held over an interval
COMMANDS = (*HELD, "thrust_acceleration")  # signals that may act late; a rotor's speed is what acts
SETTLED = 3.0  # lags, after which what went before a segment is forgotten
RATES = ("w_x", "w_y", "w_z")
READINGS = ("acc_x", "acc_y", "acc_z")
QUATERNION = ("q_w", "q_x", "q_y", "q_z")


@dataclass(frozen=True)
class Samples:
    """Samples of one or more flights. time: (k,) s. flight: (k,) index into names. segment: (k,), unique number.

    force: specific force, (k, 3) body FLU (m/s^2). velocity: air-relative, (k, 3) body FLU (m/s).
    signal: rotors' signal, (k, n) ((k, 1) for thrust_acceleration). voltage: (k,) V, or None where a flight lacks it.
    rate: body rates, (k, 3) FLU (rad/s), or None where a flight lacks them. held: (k,), whether the signal was held
    over the interval that ends at the sample. delay, lag: dead time and time constant that the signal went through (s).
    later: the signal with one standard error more of delay, (k, n), or None where it has none.
    """

    time: np.ndarray
    flight: np.ndarray
    segment: np.ndarray
    force: np.ndarray
    velocity: np.ndarray
    signal: np.ndarray
    held: np.ndarray
    kind: str
    names: tuple[str, ...]
    voltage: np.ndarray | None = None
    rate: np.ndarray | None = None
    delay: float = 0.0
    lag: float = 0.0
    later: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.time)

    def thinned(self, most: int) -> Samples:
        """At most so many samples, evenly spaced: neighbouring samples are nearly redundant."""
        step = -(-len(self) // most)
        return self if step == 1 else self.rows(np.arange(0, len(self), step))

    def rows(self, selection: np.ndarray) -> Samples:
        """The samples of a mask or index array; the flights keep their numbers."""
        chosen = {k: part[selection] for k, part in vars(self).items() if isinstance(part, np.ndarray)}
        return replace(self, **chosen)

    def delayed(self, delay: float, lag: float = 0.0) -> Samples:
        """With the signal of `delay` (s) earlier, through a first-order lag (s); see command_lag.lagged."""
        if not (delay or lag):
            return self
        signal = late_signal(self.time, self.segment, self.signal, delay, lag, held=self.held)
        return replace(self, signal=signal, delay=self.delay + delay, lag=self.lag + lag)

    def command_lag(self) -> CommandLag | None:
        """How late the specific force is behind the signal; see command_lag.find_lag."""
        return find_lag(self.time, self.segment, self.signal, self.force[:, 2], self.velocity, self.held)

    def during(self, values: np.ndarray) -> np.ndarray:
        """Values (k, n) of the signal, over the interval that begins at each sample."""
        last = np.searchsorted(self.segment, self.segment, "right") - 1  # of the segment
        later = np.minimum(np.arange(len(self)) + 1, last)
        return np.where(self.held[:, None], values[later], values)


def late_signal(
    time: np.ndarray, segment: np.ndarray, signal: np.ndarray, delay: float, lag: float, *, held: np.ndarray
) -> np.ndarray:
    """L[s], (k, n), segment by segment. time, held: (k,); segment: (k,), ascending numbers."""
    late = signal.astype(float)
    period = period_of(time)
    ends = np.flatnonzero(np.diff(segment)) + 1
    for rows in np.split(np.arange(len(time)), ends):
        late[rows] = lagged(late[rows], period, delay, lag, ends=bool(held[rows[0]]))
    return late


def rotor_columns(flight: Flight, kind: str) -> list[str]:
    """Names of a signal's columns in the rotors' order, [] where the flight has none."""
    if kind == "thrust_acceleration":
        return [kind] if kind in flight.columns else []
    names = [name for name in flight.columns if re.fullmatch(rf"{kind}_\d+", name)]
    return sorted(names, key=lambda name: int(name.rsplit("_", 1)[1]))


def choose_signal(flights: Sequence[Flight], asked: str | None = None) -> str:
    """The signal for the thrust: the one asked for, or the first of SIGNALS that every flight has.

    Raises DataError where the flights have none in common.
    """
    for kind in [asked] if asked else SIGNALS:
        lacking = [name_of(flight, i) for i, flight in enumerate(flights) if not rotor_columns(flight, kind)]
        if not lacking:
            return kind
    columns = ", ".join(f"{kind}_0 .." if kind != "thrust_acceleration" else kind for kind in SIGNALS)
    if asked:
        raise DataError(f"{lacking[0]}: columns {asked}_0 .. are missing; identification needs one of {columns}")
    first = name_of(flights[0], 0)
    raise DataError(f"{first}: no signal of the thrust is in every flight; identification needs one of {columns}")


def gather(flights: Sequence[Flight], kind: str, names: Sequence[str] | None = None) -> Samples:
    """All samples of the flights. kind: a name in SIGNALS. names: one per flight, for messages.

    Raises DataError for a missing column or a value that is not finite (flight, column, row), and for flights with
    different numbers of rotors.
    """
    names = tuple(names or [name_of(flight, i) for i, flight in enumerate(flights)])
    optional = []  # that every flight has
    if all("battery_voltage" in flight.columns for flight in flights):
        optional.append("voltage")
    if all(_has_rates(flight) for flight in flights):
        optional.append("rate")
    parts: list[dict[str, np.ndarray]] = []
    for index, (flight, name) in enumerate(zip(flights, names, strict=True)):
        part = _part(flight, name, kind, optional)
        count = len(part["time"])
        part["flight"] = np.full(count, index)
        if parts:
            part["segment"] += parts[-1]["segment"][-1] + 1
            rotors = [each["signal"].shape[1] for each in (part, parts[0])]
            if rotors[0] != rotors[1]:
                raise DataError(f"{name}: {rotors[0]} rotors, {names[0]} has {rotors[1]}")
        parts.append(part)
    arrays: dict[str, Any] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Samples(kind=kind, names=names, **arrays)


def _has_rates(flight: Flight) -> bool:
    return all(name in flight.columns and np.isfinite(flight[name]).all() for name in RATES)


def _part(flight: Flight, name: str, kind: str, optional: Sequence[str]) -> dict[str, np.ndarray]:
    """Samples of one flight by the fields of Samples; segments from 0 on."""
    simulated = not flight.metadata.get("recorded", False)
    first = int(simulated)
    held = simulated and kind in HELD
    rotors = rotor_columns(flight, kind)
    columns = ["t", *QUATERNION, *VELOCITY, *READINGS, *rotors]
    if "wind_x" in flight.columns:
        columns += WIND
    if "voltage" in optional:
        columns.append("battery_voltage")
    check_columns(flight, name, columns, first)
    count = len(flight) - first
    number = flight.columns.get("segment", np.zeros(len(flight)))[first:]
    part = {
        "time": flight.t[first:],
        "segment": np.cumsum(np.diff(number, prepend=number[:1]) != 0),
        "force": flight.stack(READINGS)[first:],
        "velocity": flight.air_velocity[first:],
        "signal": flight.stack(rotors).astype(float)[first - held :][:count],
        "held": np.full(count, held),
    }
    if "voltage" in optional:
        voltage = part["voltage"] = flight["battery_voltage"][first:]
        if not voltage.min() > 0:
            row = int(np.argmin(voltage)) + first
            raise DataError(f"{name}: battery_voltage is {voltage.min():g} V in row {row}, it must be positive")
    if "rate" in optional:
        part["rate"] = flight.stack(RATES)[first:].astype(float)
    return part


def gather_to_fit(flights: Sequence[Flight], signal: str | None = None, names: Sequence[str] | None = None) -> Samples:
    """All samples of the flights, the commands of simulated ones as late as they act; see `choose_signal`, `gather`."""
    samples = gather(flights, choose_signal(flights, signal), names)
    if samples.kind not in COMMANDS:
        return samples
    late = samples.command_lag()
    if late is None or not late.late:
        return samples
    first = samples.time[np.searchsorted(samples.segment, samples.segment)]
    known = samples.time - first >= late.dead_time + SETTLED * late.lag
    later = samples.delayed(late.dead_time + late.error, late.lag).signal
    delayed = samples.delayed(late.dead_time, late.lag)
    return replace(delayed, later=later).rows(known)


@dataclass(frozen=True)
class FlightRows:
    """One flight, to be predicted or learned from: samples, body rate (k, 3), index of the first sample in the flight
    (the first row of a simulated one has no reading yet)."""

    name: str
    flight: Flight
    samples: Samples
    rate: np.ndarray
    first: int

    @property
    def dt(self) -> float:
        return period_of(self.samples.time)

    @property
    def speed(self) -> np.ndarray:
        return norms(self.samples.velocity)


def read_rows(flight: Flight, name: str, signal: str, delay: float = 0.0, lag: float = 0.0) -> FlightRows:
    """delay, lag: of the thrust behind its signal (s). Raises DataError where the flight lacks what is needed, body
    rates too, or where these are not finite."""
    samples = gather([flight], signal, [name]).delayed(delay, lag)
    first = len(flight) - len(samples)
    check_columns(flight, name, RATES, first)
    return FlightRows(name, flight, samples, flight.stack(RATES)[first:], first)


def check_columns(flight: Flight, name: str, columns: Sequence[str], first: int) -> None:
    """Raise DataError unless the flight has the columns, finite from row `first` on, and enough rows."""
    for column in columns:
        if column not in flight.columns:
            raise DataError(f"{name}: column {column!r} is missing; identification needs {', '.join(columns)}")
        bad = np.flatnonzero(~np.isfinite(np.asarray(flight[column], float)[first:]))
        if len(bad):
            raise DataError(f"{name}: column {column!r} is not finite in row {bad[0] + first} ({len(bad)} such rows)")
    if len(flight) < first + 3:
        raise DataError(f"{name}: {len(flight)} samples, identification needs at least {first + 3}")
