"""From flight files to files of identified coefficients."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from quadexp.config_flight import RotorConfig, VehicleConfig
from quadexp.errors import DataError, UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.provenance import provenance, versions
from quadexp.flight.schema import Flight
from quadexp.flight.store import check_output, read_flight, write_table
from quadexp.identify.offline import Identification, identify_flight
from quadexp.identify.rls import RLSSettings
from quadexp.vehicle import Vehicle


def identify_files(
    flights: Sequence[Path],
    out: Path,
    *,
    vehicle: str | None = None,
    conf: Path | None = None,
    force: bool = False,
    paper: bool = False,
) -> list[tuple[Path, Identification]]:
    """Identify from every flight and write <out>/<its name>.parquet; nothing is written unless all can be.

    vehicle: name in the configuration (or in the folder `conf`); None takes the flight's own record.
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
    named = None if vehicle is None else _configured(vehicle, conf)
    found = []
    for path in flights:
        flight = read_flight(path)
        settings = RLSSettings() if paper else None
        found.append(identify_flight(flight, named or _recorded(flight, path), settings=settings, name=str(path)))
    for path, one in zip(paths, found, strict=True):
        record = {**one.metadata(), "versions": versions(), "provenance": provenance()}
        write_table(path, one.columns(), record, "estimates")
    return list(zip(paths, found, strict=True))


def _configured(name: str, conf: Path | None) -> Vehicle:
    from quadexp.compose import compose

    return build_vehicle(compose([f"vehicle={name}"], conf).vehicle)


def _recorded(flight: Flight, path: Path) -> Vehicle:
    """The vehicle that the flight's record describes."""
    record = (flight.metadata.get("config") or {}).get("vehicle")
    if not record:
        raise DataError(f"{path}: does not say which vehicle flew: pass --vehicle NAME")
    values = dict(record)
    if values.get("rotor"):
        values["rotor"] = RotorConfig(**values["rotor"])
    return build_vehicle(VehicleConfig(**values))
