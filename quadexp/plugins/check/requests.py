"""What `quadexp check` asks: recorded flights, each with its findings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from quadexp.errors import DataError, UsageError

if TYPE_CHECKING:
    from quadexp.log.schema import Flight
    from quadexp.parts.options import Folders


class Checked(NamedTuple):
    """A flight that was checked. vehicle: its name, None for one that is not known. findings: the worst first."""

    path: str
    flight: Flight
    vehicle: str | None
    findings: list[Any]

    @property
    def duration(self) -> float:
        """s, from the first row to the last."""
        return float(self.flight.t.max() - self.flight.t.min()) if len(self.flight) else 0.0

    @property
    def severities(self) -> set[str]:
        return {finding.severity for finding in self.findings}


def check(paths: Sequence[Path], vehicle: str | None = None, conf: Folders = None) -> list[Checked]:
    """Check recorded flights. vehicle: of the configuration, not the flight's own."""
    from quadexp.log.schema import Flight
    from quadexp.log.store import check_whole, read_table
    from quadexp.plugins.check.quality import check_flights

    flights: dict[str, Flight] = {}
    for path in map(str, paths):
        if path in flights:
            raise UsageError(f"{path}: given twice")
        flights[path] = Flight(*read_table(path, "flight", required=("t",)))
        check_whole(flights[path].metadata, path)
    vehicles = {path: _vehicle_of(flight, vehicle, conf) for path, flight in flights.items()}
    return [
        Checked(path, flights[path], getattr(vehicles[path], "name", None), _with_import(now, flights[path]))
        for path, now in check_flights(flights, vehicles).items()
    ]


def _vehicle_of(flight: Flight, name: str | None, conf: Folders) -> Any:
    from quadexp.experiment.vehicle_of import vehicle_named
    from quadexp.plugins.logs.vehicle_of import own_vehicle

    if name is not None:
        return vehicle_named(name, conf)
    try:
        return own_vehicle(flight, conf)
    except (DataError, UsageError):  # a record of another version: the limits are then not known
        return None


def _with_import(findings: list[Any], flight: Flight) -> list[Any]:
    """Findings now, and those that the import made on the log itself, which the flight no longer shows."""
    from quadexp.plugins.logs.finding import Finding, worst_first

    names = {finding.name for finding in findings}
    earlier = []
    for record in flight.metadata.get("findings") or []:
        if {"name", "severity", "where"} <= set(record) and record["name"] not in names:
            severity = record["severity"].replace("blocking", "warning")  # it was mended or accepted at the import
            texts = {key: record.get(key, "") for key in ("measured", "allowed", "advice")}
            earlier.append(Finding(record["name"], severity, f"the log, {record['where']}", **texts))
    return worst_first(findings + earlier)
