"""Keys of a sweep's cells: the hash of everything that decides a flight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from quadexp.config.schema import Config
from quadexp.experiment.identity import digest, flight_record

SCHEMA = 1  # of what a cell is; a higher number makes every older cell unknown


def cell_key(config: Config, inputs: Mapping[str, str], stage: str = "evaluate") -> str:
    """Key of one flight: sha256 of what decides it, 20 hex digits.

    inputs: content hash of every file the flight reads (checkpoint, trajectory file). Where a checkpoint was looked
    for takes no part; what was found does.
    """
    return digest([SCHEMA, stage, condition(config), sorted(inputs.items())])


def condition(config: Config) -> dict[str, Any]:
    """What was asked for, without the content of the files it names."""
    return without_places(flight_record(config))


def without_places(record: Mapping[str, Any]) -> dict[str, Any]:
    """A flight's record without where its checkpoint was looked for."""
    return {**record, "controller": {k: v for k, v in record["controller"].items() if k != "models"}}
