"""The configuration of the vehicle that flights say they were flown by."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from quadexp.config.schema import Config
from quadexp.errors import DataError
from quadexp.experiment.build import build_vehicle
from quadexp.log.store import read_metadata


def config_for(flights: Sequence[Path], overrides: Sequence[str] = (), conf: Path | None = None) -> Config:
    """The composed configuration with the flights' own vehicle, or the one that an override names.

    Raises DataError where the flights are of different vehicles, or of one that the configuration describes otherwise.
    """
    from quadexp.config.compose import compose

    flown = {str(path): dict(read_metadata(path).get("vehicle") or {}) for path in flights}
    named = {path: record for path, record in flown.items() if record.get("fingerprint")}
    known = {record["fingerprint"] for record in named.values()}
    if len(known) > 1:
        names = ", ".join(sorted({f"{record.get('name')} ({record['fingerprint']})" for record in named.values()}))
        raise DataError(f"the flights are of different vehicles: {names}")
    given = list(overrides)
    if named and not any(text.startswith("vehicle=") for text in given):
        given.insert(0, f"vehicle={next(iter(named.values()))['name']}")
    config = compose(given, conf)
    vehicle = build_vehicle(config.vehicle)
    if known and vehicle.fingerprint not in known:
        path, record = next(iter(named.items()))
        raise DataError(
            f"{path}: flown by vehicle {record.get('name')} ({record['fingerprint']}), the configuration says"
            f" {vehicle.name} ({vehicle.fingerprint}): pass the vehicle=... it was imported with"
        )
    return config
