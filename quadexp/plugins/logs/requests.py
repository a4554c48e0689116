"""What can be asked of recorded flights, a function a request; see quadexp/requests.py."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from quadexp.errors import DataError, UsageError

if TYPE_CHECKING:
    from quadexp.log.schema import Flight
    from quadexp.parts.options import Folders


def identify(
    flights: Sequence[Path],
    out: Path,
    conf: Folders = None,
    *,
    chosen: Callable[[str, str], None] = lambda method, reason: None,
    method: str | None = None,
    vehicle: str | None = None,
    settings: Mapping[str, Any],
    figures: bool = True,
    figure: Path | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Identify a vehicle from its flights. chosen: is told the method that is taken, and why. settings: of the
    regression (plugins.logs.vehicle_model.FitSettings). The report has `method`, and what this method gives."""
    from quadexp.experiment.vehicle_of import vehicle_named
    from quadexp.plugins.logs.identify import choose_method, identify_files

    named = None if vehicle is None else vehicle_named(vehicle, conf)
    choice = choose_method(flights, method, named)
    chosen(choice.method, choice.reason)
    if choice.method == "delays":
        from quadexp.plugins.logs.delays import identify_delays

        return {"method": "delays", **identify_delays(flights, named, conf, figure)}
    if choice.method == "torque":
        from quadexp.plugins.logs.torque import identify_torque

        return {"method": "torque", **identify_torque(flights, named, conf)}
    if choice.method == "rls":
        estimates = identify_files(flights, out, vehicle=vehicle, conf=conf, force=force)
        records = [{"path": path, **estimate.metadata()} for path, estimate in estimates]
        lines = [line for path, estimate in estimates for line in (*estimate.lines(), path)]
        return {"method": "rls", "out": out, "flights": records, "lines": lines}

    from quadexp.plugins.logs.identify import identify_flights
    from quadexp.plugins.logs.vehicle_model import FitSettings

    regression = FitSettings(**settings)
    return dict(identify_flights(flights, out, named, regression, force=force, figures=figures, conf=conf))


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
    from quadexp.plugins.logs.check import check_flights

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
    from quadexp.experiment.vehicle_of import own_vehicle, vehicle_named

    if name is not None:
        return vehicle_named(name, conf)
    try:
        return own_vehicle(flight, conf)
    except (DataError, UsageError):  # a record of another version: the limits are then not known
        return None


def _with_import(findings: list[Any], flight: Flight) -> list[Any]:
    """Findings now, and those that the import made on the log itself, which the flight no longer shows."""
    from quadexp.plugins.logs.check.finding import Finding, worst_first

    names = {finding.name for finding in findings}
    earlier = []
    for record in flight.metadata.get("findings") or []:
        if {"name", "severity", "where"} <= set(record) and record["name"] not in names:
            severity = record["severity"].replace("blocking", "warning")  # it was mended or accepted at the import
            texts = {key: record.get(key, "") for key in ("measured", "allowed", "advice")}
            earlier.append(Finding(record["name"], severity, f"the log, {record['where']}", **texts))
    return worst_first(findings + earlier)
