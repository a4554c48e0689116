"""The vehicle of flights: recorded in them, or named there."""

from __future__ import annotations

from pathlib import Path

from quadexp.errors import DataError, UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.vehicle_of import vehicle_named
from quadexp.log.schema import Flight
from quadexp.parts.options import Folders
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
