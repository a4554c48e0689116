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
    named = []  # the path of each flight that says its vehicle, and what it says
    for path in flights:
        record = read_metadata(path).get("vehicle") or {}
        if record.get("fingerprint"):
            named.append((path, record))
    words = sorted({f"{record.get('name')} ({record['fingerprint']})" for _, record in named})
    if len({record["fingerprint"] for _, record in named}) > 1:
        raise DataError(f"the flights are of different vehicles: {', '.join(words)}")
    values = list(overrides)
    if named:
        path, record = named[0]
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
