"""The configuration for flights that are there."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from quadexp.errors import DataError
from quadexp.experiment.build import build_vehicle
from quadexp.log.store import read_metadata
from quadexp.parts.compose import session
from quadexp.parts.options import Folders
from quadexp.parts.schema import Config
from quadexp.plugins.margins.recorded import recorded_words


def config_for(flights: Sequence[Path], overrides: Sequence[str] = (), conf: Folders = None) -> Config:
    """The composed configuration with the vehicle recorded in the flights, or the one in an override.

    Raises DataError where the flights are of different vehicles, or of one with other parameters in the configuration.
    """
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
