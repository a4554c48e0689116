"""Age of the estimate, dead time and lag of the commands of recorded flights, and the settings that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.control.delay.timing import Delays, Stream, find_delays
from quadexp.errors import DataError, UsageError
from quadexp.experiment.identify import own_vehicle
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.physics.state import STATE_COLUMNS
from quadexp.physics.vehicle import Vehicle

ACCELEROMETER = ("acc_x", "acc_y", "acc_z")
EVEN = 1e-3  # share of a period by which samples may be uneven
NOTHING = 1.5e-3  # s: less than this is no delay that is worth a setting


def identify_delays(paths: Sequence[Path], vehicle: Vehicle | None, conf: Path | None) -> dict[str, Any]:
    """{"flights": a record of each, "lines": the report}.

    vehicle: None: that recorded in the flights. Raises DataError where a flight lacks something, UsageError where its
    vehicle is not known.
    """
    if not paths:
        raise UsageError("identify: no flight given")
    records, lines = [], list[str]()
    for path in paths:
        flight = read_flight(path)
        flown = vehicle or own_vehicle(flight, conf)
        if flown is None:
            raise UsageError(f"{path}: its vehicle is not known here; name it: --vehicle NAME")
        found = find_delays(told(flight, str(path)), flown)
        settings = overrides(found)
        records.append({"path": str(path), **asdict(found), "overrides": settings})
        lines += [f"{path}", *(f"  {line}" for line in report(found)), f"  set: {' '.join(settings) or 'nothing'}"]
    return {"flights": records, "lines": lines}


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
