"""The configuration with the vehicle recorded in flights."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from quadexp.errors import DataError
from quadexp.experiment.build import build_vehicle
from quadexp.log.store import read_metadata
from quadexp.parts.schema import Config


def config_for(flights: Sequence[Path], overrides: Sequence[str] = (), conf: Path | None = None) -> Config:
    """The composed configuration with the vehicle recorded in the flights, or the one in an override.

    Raises DataError where the flights are of different vehicles, or of one with other parameters in the configuration.
    """
    from quadexp.parts.compose import compose

    flown = {str(path): dict(read_metadata(path).get("vehicle") or {}) for path in flights}
    named = {path: record for path, record in flown.items() if record.get("fingerprint")}
    fingerprints = {record["fingerprint"] for record in named.values()}
    if len(fingerprints) > 1:
        names = ", ".join(sorted({f"{record.get('name')} ({record['fingerprint']})" for record in named.values()}))
        raise DataError(f"the flights are of different vehicles: {names}")
    values = list(overrides)
    if named and not any(text.startswith("vehicle=") for text in values):
        values.insert(0, f"vehicle={next(iter(named.values()))['name']}")
    config = compose(values, conf)
    vehicle = build_vehicle(config.vehicle)
    if fingerprints and vehicle.fingerprint not in fingerprints:
        path, record = next(iter(named.items()))
        raise DataError(
            f"{path}: flown by vehicle {record.get('name')} ({record['fingerprint']}), the configuration has"
            f" {vehicle.name} ({vehicle.fingerprint}): pass the vehicle=... it was imported with"
        )
    return config
