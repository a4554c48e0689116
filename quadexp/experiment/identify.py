"""From flight files to identified coefficients, by one of two methods.

rls         Lei & Li's recursive least squares on the blade-element model, flight by flight: needs rotor speeds and the
            rotors' geometry; gives C_d0, C_la and C_D.
regression  thrust curve, drag and lumped blade-element coefficients over all flights together: needs a signal of the
            thrust; gives a vehicle model (quadexp.experiment.identify_vehicle).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.experiment.build import build_vehicle
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
from quadexp.models.rls import RLSSettings
from quadexp.models.samples import QUATERNION, rotor_columns
from quadexp.parts.settings import made
from quadexp.physics.vehicle import FORMER_NAMES, Vehicle
from quadexp.provenance import provenance, versions
from quadexp.writer import check_output

METHODS = ("rls", "regression", "delays")


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


def own_vehicle(flight: Flight, conf: Path | None = None) -> Vehicle | None:
    """The vehicle described in a flight's metadata, or named there if the configuration's is identical; else None."""
    if (flight.metadata.get("config") or {}).get("vehicle"):
        return _recorded(flight, Path(str(flight.metadata.get("name", "flight"))))
    record = flight.metadata.get("vehicle") or {}
    try:
        named = configured_vehicle(str(record["name"]), conf) if record.get("name") else None
    except UsageError:
        return None
    return named if named is not None and named.fingerprint == record.get("fingerprint") else None


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
    twice = [path for path, count in Counter(paths).items() if count > 1]
    if twice:
        raise UsageError(f"identify: two flights named {twice[0].stem} would both be written to {twice[0]}")
    for path in paths:
        check_output(path, force=force)
    named = None if vehicle is None else configured_vehicle(vehicle, conf)
    results = []
    for path in flights:
        flight = read_flight(path, whole=True)
        settings = RLSSettings() if paper else None
        results.append(identify_flight(flight, named or _recorded(flight, path), settings=settings, name=str(path)))
    for path, one in zip(paths, results, strict=True):
        record = {**one.metadata(), "versions": versions(), "provenance": provenance()}
        write_table(path, one.columns(), record, "estimates", force=force)
    return list(zip(paths, results, strict=True))


def configured_vehicle(name: str, conf: Path | None) -> Vehicle:
    """A vehicle of the configuration, or of the folder `conf`; raises UsageError for an unknown name."""
    from quadexp.parts.compose import compose

    return build_vehicle(compose([f"vehicle={name}"], conf).vehicle)


def _recorded(flight: Flight, path: Path) -> Vehicle:
    """The vehicle described in a flight's metadata."""
    record = (flight.metadata.get("config") or {}).get("vehicle")
    if not record:
        raise DataError(f"{path}: has no record of its vehicle: pass --vehicle NAME")
    current = {former: name for name, former in FORMER_NAMES.items()}  # flights of earlier versions
    return build_vehicle(made(Vehicle, {current.get(key, key): value for key, value in record.items()}))
