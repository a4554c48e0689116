"""The vehicle of flights: recorded in them, or named there."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from quadexp.errors import DataError, UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.vehicle_of import vehicle_named
from quadexp.log.schema import Flight
from quadexp.log.store import read_metadata
from quadexp.parts.options import Folders
from quadexp.parts.schema import Config
from quadexp.parts.settings import made
from quadexp.physics.vehicle import Vehicle


def own_vehicle(flight: Flight, conf: Folders = None) -> Vehicle | None:
    """The vehicle described in a flight's metadata, or named there if the configuration's is identical; else None."""
    if (flight.metadata.get("config") or {}).get("vehicle"):
        return recorded_vehicle(flight, Path("flight"))
    record = flight.metadata.get("vehicle") or {}
    try:
        named = vehicle_named(str(record["name"]), conf) if record.get("name") else None
    except UsageError:
        return None
    return named if named is not None and named.fingerprint == record.get("fingerprint") else None


def recorded_vehicle(flight: Flight, path: Path) -> Vehicle:
    """The vehicle described in a flight's metadata; DataError where there is none."""
    record = (flight.metadata.get("config") or {}).get("vehicle")
    if not record:
        raise DataError(f"{path}: has no record of its vehicle: pass --vehicle NAME")
    return build_vehicle(made(Vehicle, record))


def config_for(flights: Sequence[Path], overrides: Sequence[str] = (), conf: Folders = None) -> Config:
    """The composed configuration with the vehicle recorded in the flights, or the one in an override.

    Raises DataError where the flights are of different vehicles, or of one with other parameters in the configuration.
    """
    from quadexp.parts.compose import session
    from quadexp.parts.recorded import recorded_words

    flown = {str(path): dict(read_metadata(path).get("vehicle") or {}) for path in flights}
    named = {path: record for path, record in flown.items() if record.get("fingerprint")}
    words = sorted({f"{record.get('name')} ({record['fingerprint']})" for record in named.values()})
    if len({record["fingerprint"] for record in named.values()}) > 1:
        raise DataError(f"the flights are of different vehicles: {', '.join(words)}")
    values = list(overrides)
    path, record = next(iter(named.items()), ("", {}))
    with session(conf) as composer:
        if named and not any(text.startswith("vehicle=") for text in values):
            config = read_metadata(path).get("config") or {}
            if record["name"] in composer.options("vehicle") or "vehicle" not in config:
                values.insert(0, f"vehicle={record['name']}")
            else:  # a name of its own
                values = recorded_words(composer, {"vehicle": config["vehicle"]}, values)
        config = composer.compose(values, "validate")
    vehicle = build_vehicle(config.vehicle)
    if named and vehicle.fingerprint != record["fingerprint"]:
        has = f"the configuration has {vehicle.name} ({vehicle.fingerprint})"
        raise DataError(f"{path}: flown by vehicle {words[0]}, {has}: pass the vehicle=... it was imported with")
    return config
